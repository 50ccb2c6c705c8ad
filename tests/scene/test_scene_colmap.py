"""Scenes through pycolmap and COLMAP's files."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from random_scenes import (
    CAMERAS,
    OtherCamera,
    assert_same_points,
    assert_same_poses,
    random_scene,
    scenes,
    small_scene,
)

from toolkit.errors import CapabilityError, DataError, RunError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene, Tracks, colmap
from toolkit.scene.colmap import (
    read_colmap,
    scene_from_pycolmap,
    scene_to_pycolmap,
    write_colmap,
)

PICTURES = Path("/pictures")


def registered_only(scene: Scene) -> Scene:
    """What COLMAP can hold of a scene: posed frames in order, their cameras, points with tracks."""
    kept = [i for i, frame in enumerate(scene.frames) if frame.cam_from_world is not None]
    frames = tuple(
        Frame(scene.frames[i].name, scene.frames[i].camera_id, scene.frames[i].cam_from_world) for i in kept
    )
    cameras = {i: camera for i, camera in scene.cameras.items() if i in {frame.camera_id for frame in frames}}
    empty = Tracks(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)))
    points = scene.points or Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    tracks = points.tracks or empty
    moved = dataclasses.replace(tracks, frame=np.array([kept.index(i) for i in tracks.frame], dtype=np.int64))
    error = points.error if points.error is not None and np.isfinite(points.error).any() else None
    return Scene(PICTURES, cameras, frames, dataclasses.replace(points, tracks=moved, error=error))


def assert_same(one: Scene, other: Scene) -> None:
    assert [f.name for f in one.frames] == [f.name for f in other.frames]
    assert [f.camera_id for f in one.frames] == [f.camera_id for f in other.frames]
    assert dict(one.cameras) == dict(other.cameras)
    assert_same_poses(one, other)
    assert_same_points(one.points, other.points)


@settings(max_examples=60, deadline=None)
@given(scenes)
def test_a_scene_survives_pycolmap(scene: Scene) -> None:
    made = scene_to_pycolmap(scene)
    assert made.num_reg_images() == len(scene.registered)
    assert made.is_valid()
    assert_same(scene_from_pycolmap(made, PICTURES), registered_only(scene))


@settings(max_examples=40, deadline=None)
@given(scenes)
def test_a_scene_survives_like_itself(scene: Scene) -> None:
    again = scene_from_pycolmap(scene.to_pycolmap(), scene.image_dir, like=scene)
    assert [dataclasses.replace(f, cam_from_world=None, prior=None) for f in again.frames] == [
        dataclasses.replace(f, cam_from_world=None, prior=None) for f in scene.frames
    ]
    assert [f.prior for f in again.frames] == [f.prior for f in scene.frames]
    assert dict(again.cameras) == dict(scene.cameras)
    assert (again.mask_dir, again.georeference) == (scene.mask_dir, scene.georeference)
    assert_same_poses(again, scene)


@pytest.mark.parametrize("binary", [True, False])
@settings(max_examples=25, deadline=None)
@given(scene=scenes)
def test_a_scene_survives_the_files_and_pycolmap_reads_the_same(scene: Scene, binary: bool) -> None:
    if not binary:
        scene = scene.replace(
            frames=tuple(dataclasses.replace(f, name=f.name.replace(" ", "_")) for f in scene.frames)
        )
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "sparse" / "0"
        write_colmap(scene, place, binary=binary)
        ours = read_colmap(Path(folder), PICTURES)
        theirs = scene_from_pycolmap(pycolmap.Reconstruction(str(place)), PICTURES)
    assert_same(ours, registered_only(scene))
    assert_same(ours, theirs)


@pytest.mark.parametrize("binary", [True, False])
def test_images_of_a_rig_get_their_own_poses(tmp_path: Path, binary: bool) -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 2
    options.num_points3D = 20
    options.sensor_from_rig_translation_stddev, options.sensor_from_rig_rotation_stddev = 0.5, 10.0
    rigged = pycolmap.synthesize_dataset(options)
    if binary:
        rigged.write_binary(tmp_path)
    else:
        rigged.write_text(tmp_path)
    ours = read_colmap(tmp_path, PICTURES)
    assert_same(ours, scene_from_pycolmap(rigged, PICTURES))
    assert len(ours.registered) == 8
    tracks = ours.points.tracks if ours.points else None
    assert tracks is not None
    for index, frame in enumerate(ours.frames):
        rows = tracks.frame == index
        assert rows.sum() > 10
        assert frame.cam_from_world is not None
        seen = ours.camera_of(frame).project(frame.cam_from_world.apply(ours.points.xyz[tracks.point[rows]]))
        # Synthetic observations are exact projections.
        np.testing.assert_allclose(seen, tracks.pixel[rows], atol=1e-9)


def test_numbers_in_the_reconstruction_follow_the_scene() -> None:
    made = scene_to_pycolmap(small_scene())
    assert sorted(made.images.keys()) == [1, 3]
    assert sorted(made.cameras.keys()) == [1, 2]
    assert sorted(made.points3D.keys()) == [1, 2, 3]
    assert made.image(3).name == "c.jpg"
    assert [(e.image_id, e.point2D_idx) for e in made.point3D(3).track.elements] == [(3, 1), (1, 1)]
    np.testing.assert_array_equal(made.image(1).points2D[1].xy, [7.0, 8.0])


def test_observations_in_frames_without_pose_are_left_out() -> None:
    scene = small_scene()
    assert scene.points is not None
    tracks = Tracks(np.array([0, 0, 1]), np.array([0, 1, 1]), np.ones((3, 2)))
    again = scene_from_pycolmap(
        scene.replace(points=dataclasses.replace(scene.points, tracks=tracks)).to_pycolmap(), PICTURES, like=scene
    )
    assert again.points is not None
    assert again.points.tracks is not None
    assert again.points.tracks.point.tolist() == [0]
    assert again.points.tracks.frame.tolist() == [0]


def test_keypoints_without_point_are_left_out_and_unposed_images_stay_without_pose() -> None:
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(CAMERAS[0].to_pycolmap(4))
    made.add_image_with_trivial_frame(
        pycolmap.Image(name="a", keypoints=np.ones((3, 2)), camera_id=4, image_id=8), pycolmap.Rigid3d()
    )
    made.add_image_with_trivial_frame(pycolmap.Image(name="b", keypoints=np.ones((3, 2)), camera_id=4, image_id=5))
    made.add_point3D(np.ones(3), pycolmap.Track([pycolmap.TrackElement(8, 2)]), np.array([1, 2, 3], np.uint8))
    scene = scene_from_pycolmap(made, PICTURES)
    assert [(f.name, f.cam_from_world is None) for f in scene.frames] == [("b", True), ("a", False)]
    assert scene.points is not None
    assert scene.points.error is None
    assert scene.points.tracks is not None
    assert scene.points.tracks.frame.tolist() == [1]


class TestLike:
    """What ``like`` keeps, and how cameras get their numbers."""

    def reconstruction(self, cameras: dict[str, int], focal: float = 70.0) -> pycolmap.Reconstruction:
        made = pycolmap.Reconstruction()
        for number in sorted(set(cameras.values())):
            camera = ColmapCamera.pinhole(64, 48, focal + number)
            made.add_camera_with_trivial_rig(camera.to_pycolmap(number))
        for image_id, (name, number) in enumerate(sorted(cameras.items(), reverse=True), start=1):
            made.add_image_with_trivial_frame(
                pycolmap.Image(name=name, camera_id=number, image_id=image_id), pycolmap.Rigid3d()
            )
        return made

    def scene(self, cameras: dict[str, int]) -> Scene:
        start = ColmapCamera("PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0), prior_focal_length=True)
        return Scene(
            PICTURES,
            dict.fromkeys(cameras.values(), start),
            tuple(Frame(name, number, RigidTransform.identity(), "test", 3.0) for name, number in cameras.items()),
        )

    def test_a_shared_camera_keeps_its_number_and_refines_frames_that_were_not_registered(self) -> None:
        like = self.scene({"z.jpg": 5, "a.jpg": 5, "m.jpg": 5})
        merged = scene_from_pycolmap(self.reconstruction({"a.jpg": 1, "z.jpg": 1}), PICTURES, like=like)
        assert [(f.name, f.camera_id, f.split, f.time) for f in merged.frames] == [
            ("z.jpg", 5, "test", 3.0),
            ("a.jpg", 5, "test", 3.0),
            ("m.jpg", 5, "test", 3.0),
        ]
        assert [f.cam_from_world is None for f in merged.frames] == [False, False, True]
        assert dict(merged.cameras) == {5: ColmapCamera.pinhole(64, 48, 71.0)}
        # The reconstruction's camera did not know it any more.
        assert merged.cameras[5].prior_focal_length

    def test_cameras_that_were_split_get_new_numbers(self) -> None:
        like = self.scene({"a.jpg": 5, "b.jpg": 5, "c.jpg": 5})
        merged = scene_from_pycolmap(self.reconstruction({"a.jpg": 1, "b.jpg": 2}), PICTURES, like=like)
        assert [f.camera_id for f in merged.frames] == [6, 7, 5]
        assert [merged.cameras[i].params[0] for i in (5, 6, 7)] == [50.0, 71.0, 72.0]

    def test_a_camera_that_lost_all_its_frames_goes(self) -> None:
        like = self.scene({"a.jpg": 5, "b.jpg": 5})
        merged = scene_from_pycolmap(self.reconstruction({"a.jpg": 1, "b.jpg": 2}), PICTURES, like=like)
        assert sorted(merged.cameras) == [6, 7]

    def test_cameras_that_were_joined_become_one(self) -> None:
        like = self.scene({"a.jpg": 2, "b.jpg": 3})
        merged = scene_from_pycolmap(self.reconstruction({"a.jpg": 1, "b.jpg": 1}), PICTURES, like=like)
        assert [f.camera_id for f in merged.frames] == [4, 4]
        assert sorted(merged.cameras) == [4]

    def test_an_image_that_the_scene_does_not_know_is_an_error(self) -> None:
        with pytest.raises(DataError, match=r"images that the scene does not have.*found x\.jpg"):
            scene_from_pycolmap(self.reconstruction({"x.jpg": 1}), PICTURES, like=self.scene({"a.jpg": 1}))


def test_only_cameras_of_registered_frames_must_be_colmaps() -> None:
    scene = small_scene()
    other = scene.replace(cameras={**scene.cameras, 9: OtherCamera()})
    assert scene_to_pycolmap(other).num_cameras() == 2
    broken = scene.replace(cameras={**scene.cameras, 2: OtherCamera()})
    with pytest.raises(
        CapabilityError, match=r"Camera 2 cannot be given to COLMAP.*one of COLMAP's models.*OtherCamera"
    ):
        scene_to_pycolmap(broken)


@pytest.mark.parametrize(
    "wrong",
    [
        RigidTransform(np.eye(3), np.array([0.0, np.nan, 0.0])),
        RigidTransform(np.diag([1.0, 1.0, -1.0]), np.zeros(3)),
        RigidTransform(np.eye(3) * 1.01, np.zeros(3)),
        RigidTransform(np.full((3, 3), np.inf), np.zeros(3)),
    ],
)
def test_a_pose_that_is_no_rigid_motion_is_refused(wrong: RigidTransform) -> None:
    scene = Scene(PICTURES, {1: CAMERAS[0]}, (Frame("a.jpg", 1, wrong),))
    with pytest.raises(DataError, match=r"pose of frame 'a\.jpg' is no rigid motion.*orthonormal"):
        scene_to_pycolmap(scene)


@pytest.mark.parametrize("number", [-1, 2**32 - 1])
def test_a_camera_number_that_colmap_cannot_hold_is_refused(number: int) -> None:
    scene = Scene(PICTURES, {number: CAMERAS[0]}, (Frame("a.jpg", number, RigidTransform.identity()),))
    with pytest.raises(DataError, match=f"Camera number {number} cannot be given to COLMAP"):
        scene_to_pycolmap(scene)


@pytest.mark.parametrize("name", ["a\nb.jpg", "a\0.jpg", "\udcff.jpg"])
def test_a_name_that_the_files_cannot_hold_is_refused(name: str) -> None:
    scene = Scene(PICTURES, {1: CAMERAS[0]}, (Frame(name, 1, RigidTransform.identity()),))
    with pytest.raises(DataError, match=r"name .* cannot be stored.*Rename the picture"):
        scene_to_pycolmap(scene)


def test_text_files_with_names_that_colmap_would_cut_at_a_space_are_refused(tmp_path: Path) -> None:
    scene = Scene(PICTURES, {1: CAMERAS[0]}, (Frame("b b.jpg", 1, RigidTransform.identity()),))
    with pytest.raises(DataError, match=r"name 'b b\.jpg' from text files\. Write binary files"):
        write_colmap(scene, tmp_path, binary=False)
    write_colmap(scene, tmp_path)
    assert read_colmap(tmp_path, PICTURES).frames[0].name == "b b.jpg"


def test_writing_leaves_no_old_text_beside_new_binary_files_and_no_other_file_touched(tmp_path: Path) -> None:
    (tmp_path / "project.ini").write_text("mine")
    write_colmap(small_scene(), tmp_path, binary=False)
    write_colmap(random_scene(1), tmp_path, binary=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "cameras.bin",
        "frames.bin",
        "images.bin",
        "points3D.bin",
        "project.ini",
        "rigs.bin",
    ]


def test_a_crash_while_writing_never_leaves_half_a_model_that_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Crash(BaseException):
        pass

    plain = Path.replace
    for survived in range(5):
        write_colmap(small_scene(), tmp_path)
        left = survived

        def crashing(self: Path, target: Path) -> Path:
            nonlocal left
            if left == 0:
                raise Crash
            left -= 1
            return plain(self, target)

        monkeypatch.setattr(Path, "replace", crashing)
        with pytest.raises(Crash):
            write_colmap(small_scene(), tmp_path)
        monkeypatch.undo()
        with pytest.raises(DataError, match="No COLMAP model"):
            read_colmap(tmp_path, PICTURES)


def test_a_disk_that_takes_only_half_of_a_file_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(small_scene(), tmp_path)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def half(path: Path) -> Callable[..., object]:
        (path / "images.bin").write_bytes(before["images.bin"][:100])
        return read(path)

    read = colmap.read_model
    monkeypatch.setattr(colmap, "read_model", half)
    with pytest.raises(RunError, match=r"could not be written to its end; found .* MiB free\. Free some space"):
        write_colmap(small_scene(), tmp_path)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_missing_models_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"No COLMAP model in .*gone.*sparse/0.*found no folder"):
        read_colmap(tmp_path / "gone", PICTURES)
    (tmp_path / "images.bin").write_bytes(b"")
    with pytest.raises(DataError, match=r"No COLMAP model.*all \.bin or all \.txt.*found images\.bin"):
        read_colmap(tmp_path, PICTURES)


@pytest.mark.parametrize("inside", [".", "sparse/0", "sparse"])
def test_a_model_is_found_where_colmap_puts_it(tmp_path: Path, inside: str) -> None:
    write_colmap(small_scene(), tmp_path / inside)
    assert len(read_colmap(tmp_path, PICTURES)) == 2


def test_pictures_can_still_be_written_after_our_imports() -> None:
    # pycolmap carries a zlib of its own, which breaks Pillow's PNG writer where it is loaded before the system's.
    code = "import toolkit.scene\nfrom PIL import Image\nImage.new('RGB', (64, 64)).save('/dev/null', 'PNG')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()[-500:]
