"""Opening data folders of every layout."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from toolkit.errors import Cancelled, CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.scene import Frame, Points, PosePrior, Scene, Tracks
from toolkit.scene.colmap import write_colmap
from toolkit.scene.dataset import capture_fingerprint, open_capture
from toolkit.scene.folder import write_scene
from toolkit.scene.transforms import write_transforms

NAMES = tuple(f"{i}.jpg" for i in range(1, 13))
CAMERA = ColmapCamera("PINHOLE", 40, 30, (33.0, 34.0, 20.0, 15.0))
GPS = {1: "N", 2: (46.0, 50.0, 33.0), 3: "W", 4: (91.0, 59.0, 40.0), 5: b"\x00", 6: 198.0}


def pictures(folder: Path, names: tuple[str, ...] = NAMES, gps: bool = False) -> Path:
    """Write one small picture of its own brightness for each name."""
    folder.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if gps:
        exif[0x8825] = GPS
    for shade, name in enumerate(names):
        Image.new("RGB", (40, 30), (shade, 100, 100)).save(folder / name, exif=exif)
    return folder


def posed(image_dir: Path, names: tuple[str, ...] = NAMES) -> Scene:
    """Return a scene of ``names`` along a line, with one point that all see."""
    frames = tuple(
        Frame(name, 3, RigidTransform(np.eye(3), np.array([-i, 0.0, 5.0]))) for i, name in enumerate(names)
    )
    count = len(names)
    tracks = Tracks(np.zeros(count, int), np.arange(count), np.ones((count, 2)))
    return Scene(image_dir, {3: CAMERA}, frames, Points(np.zeros((1, 3)), np.zeros((1, 3), np.uint8), None, tracks))


def held_out(scene: Scene) -> list[str]:
    return [frame.name for frame in scene.frames if frame.split == "test"]


class TestSceneFolder:
    """A folder with scene.json."""

    def test_its_poses_are_the_reference_and_the_scene_has_none(self, tmp_path: Path) -> None:
        write_scene(posed(pictures(tmp_path / "images")), tmp_path)
        capture = open_capture(tmp_path)
        assert capture.reference is not None
        assert len(capture.reference.registered) == 12
        assert capture.reference.points is not None
        assert capture.scene.registered == ()
        assert capture.scene.points is None
        assert capture.scene.cameras == capture.reference.cameras
        # Every eighth in the order of the names as text: 1, 10, 11, 12, 2, 3, 4, 5, 6, ...
        assert held_out(capture.scene) == held_out(capture.reference) == ["1.jpg", "6.jpg"]

    def test_its_own_split_stays(self, tmp_path: Path) -> None:
        scene = posed(pictures(tmp_path / "images"))
        frames = (*scene.frames[:4], dataclasses.replace(scene.frames[4], split="test"), *scene.frames[5:])
        write_scene(scene.replace(frames=frames), tmp_path)
        assert held_out(open_capture(tmp_path).scene) == ["5.jpg"]

    def test_without_poses_there_is_no_reference(self, tmp_path: Path) -> None:
        write_scene(posed(pictures(tmp_path / "images")).without_poses(), tmp_path)
        assert open_capture(tmp_path).reference is None

    def test_missing_cut_off_and_resized_pictures_are_named(self, tmp_path: Path) -> None:
        write_scene(posed(pictures(tmp_path / "images")), tmp_path)
        path = tmp_path / "images/7.jpg"
        path.write_bytes(path.read_bytes()[:-10])
        with pytest.raises(DataError, match=r"7\.jpg is cut off or damaged"):
            open_capture(tmp_path)
        assert len(open_capture(tmp_path, check=False).scene) == 12
        Image.new("RGB", (20, 15)).save(path)
        with pytest.raises(DataError, match=r"7\.jpg does not fit its camera; expected 40x30 pixels; found 20x15"):
            open_capture(tmp_path, check=False)
        path.unlink()
        with pytest.raises(DataError, match=r"7\.jpg is missing"):
            open_capture(tmp_path)

    def test_a_damaged_scene_file_is_an_error_and_not_a_folder_of_photos(self, tmp_path: Path) -> None:
        write_scene(posed(pictures(tmp_path / "images")), tmp_path)
        (tmp_path / "scene.json").write_text((tmp_path / "scene.json").read_text()[:100])
        with pytest.raises(DataError, match=r"Cannot read .*scene\.json"):
            open_capture(tmp_path)


class TestColmapFolder:
    """A folder with images/ and sparse/."""

    def test_its_poses_are_the_reference_and_its_cameras_the_scenes(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images", gps=True)
        write_colmap(posed(tmp_path / "images", NAMES[2:]), tmp_path / "sparse/0")
        capture = open_capture(tmp_path)
        assert [frame.name for frame in capture.scene.frames] == list(NAMES)
        assert capture.reference is not None
        assert [frame.name for frame in capture.reference.frames] == list(NAMES)
        assert [frame.cam_from_world is None for frame in capture.reference.frames] == [True] * 2 + [False] * 10
        assert capture.scene.registered == ()
        assert {capture.scene.camera_of(frame) for frame in capture.scene.frames} == {CAMERA}
        assert held_out(capture.scene) == held_out(capture.reference) == ["1.jpg", "6.jpg"]

    def test_positions_stay_with_the_scene_because_colmaps_world_is_another(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images", gps=True)
        write_colmap(posed(tmp_path / "images"), tmp_path / "sparse", binary=False)
        capture = open_capture(tmp_path)
        assert capture.scene.georeference is not None
        assert all(frame.prior is not None for frame in capture.scene.frames)
        assert capture.reference is not None
        assert capture.reference.georeference is None
        assert all(frame.prior is None for frame in capture.reference.frames)

    def test_the_largest_of_several_models_is_taken_and_told(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images")
        write_colmap(posed(tmp_path / "images", NAMES[:3]), tmp_path / "sparse/0")
        write_colmap(posed(tmp_path / "images", NAMES[3:]), tmp_path / "sparse/1")
        capture = open_capture(tmp_path)
        assert capture.reference is not None
        assert len(capture.reference.registered) == 9
        assert capture.warnings == ("of 2 models in sparse/ 1 was taken, with 9 of 12 images",)

    def test_half_a_model_is_told(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images")
        write_colmap(posed(tmp_path / "images"), tmp_path / "sparse/0")
        (tmp_path / "sparse/0/images.bin").unlink()
        capture = open_capture(tmp_path)
        assert capture.reference is None
        assert capture.warnings == (
            "sparse/ holds no COLMAP model (cameras, images and points3D) and was left out",
        )

    def test_a_model_of_other_pictures_is_an_error(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images", NAMES[:3])
        write_colmap(posed(tmp_path / "images"), tmp_path / "sparse/0")
        with pytest.raises(DataError, match=r"images that the scene does not have; .*found 10\.jpg, 11\.jpg"):
            open_capture(tmp_path)

    def test_a_model_of_larger_pictures_is_an_error(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images")
        scene = posed(tmp_path / "images")
        write_colmap(scene.replace(cameras={3: CAMERA.scaled(80, 60)}), tmp_path / "sparse/0")
        with pytest.raises(DataError, match=r"1\.jpg does not fit its camera; expected 80x60 pixels; found 40x30"):
            open_capture(tmp_path)


class TestTransforms:
    """A nerfstudio folder."""

    def test_its_poses_are_the_reference_and_its_cameras_and_masks_the_scenes(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images")
        (tmp_path / "masks/images").mkdir(parents=True)
        Image.new("L", (40, 30)).save(tmp_path / "masks/images/3.jpg.png")
        names = tuple(f"images/{name}" for name in NAMES[2:])
        write_transforms(posed(tmp_path, names).replace(mask_dir=tmp_path / "masks"), tmp_path / "transforms.json")
        events: list[ProgressEvent] = []
        capture = open_capture(tmp_path, progress=events.append)
        assert [frame.name for frame in capture.scene.frames] == list(names)
        assert capture.reference is not None
        assert [frame.name for frame in capture.reference.frames] == list(names)
        assert len(capture.reference.registered) == 10
        assert capture.reference.points is not None
        np.testing.assert_allclose(capture.reference.centres()[:, 0], np.arange(10), atol=1e-14)
        assert capture.scene.registered == ()
        assert capture.scene.points is None
        assert {capture.scene.camera_of(frame) for frame in capture.scene.frames} == {CAMERA}
        assert capture.scene.mask_path(capture.scene.frames[0]) == tmp_path / "masks/images/3.jpg.png"
        # Every eighth in the order of the names as text: 10, 11, 12, 3, 4, 5, 6, 7, 8, 9.
        expected = ["images/8.jpg", "images/10.jpg"]
        assert held_out(capture.scene) == held_out(capture.reference) == expected
        assert events[-1].done == 10
        assert len(capture_fingerprint(capture.scene)) == 64

    def test_its_own_split_stays(self, tmp_path: Path) -> None:
        scene = posed(pictures(tmp_path))
        frames = (*scene.frames[:4], dataclasses.replace(scene.frames[4], split="test"), *scene.frames[5:])
        write_transforms(scene.replace(frames=frames), tmp_path / "transforms.json")
        assert held_out(open_capture(tmp_path).scene) == ["5.jpg"]

    def test_a_scene_file_beside_it_counts_first_and_a_colmap_model_after_it(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images")
        full = posed(tmp_path, tuple(f"images/{name}" for name in NAMES))
        write_colmap(posed(tmp_path / "images", NAMES[:3]), tmp_path / "sparse/0")
        write_transforms(full, tmp_path / "transforms.json")
        reference = open_capture(tmp_path).reference
        assert reference is not None
        assert len(reference.registered) == 12
        write_scene(posed(tmp_path / "images", NAMES[:4]), tmp_path)
        reference = open_capture(tmp_path).reference
        assert reference is not None
        assert len(reference.registered) == 4

    def test_missing_damaged_and_resized_pictures_are_named(self, tmp_path: Path) -> None:
        write_transforms(posed(pictures(tmp_path)), tmp_path / "transforms.json")
        path = tmp_path / "7.jpg"
        path.write_bytes(path.read_bytes()[:-10])
        with pytest.raises(DataError, match=r"7\.jpg is cut off or damaged"):
            open_capture(tmp_path)
        Image.new("RGB", (20, 15)).save(path)
        with pytest.raises(DataError, match=r"7\.jpg does not fit its camera; expected 40x30 pixels; found 20x15"):
            open_capture(tmp_path, check=False)
        path.unlink()
        with pytest.raises(DataError, match=r"7\.jpg is missing"):
            open_capture(tmp_path)

    def test_a_damaged_file_is_an_error_and_not_a_folder_of_photos(self, tmp_path: Path) -> None:
        write_transforms(posed(pictures(tmp_path)), tmp_path / "transforms.json")
        (tmp_path / "transforms.json").write_text((tmp_path / "transforms.json").read_text()[:100])
        with pytest.raises(DataError, match=r"Cannot read .*transforms\.json"):
            open_capture(tmp_path)


def truth(folder: Path, name: str, text: str | None = None) -> None:
    """Write a camera at (1, 2, 3) that looks along world x, for a picture of 80 x 60 pixels."""
    folder.mkdir(exist_ok=True)
    rows = "100 0 41 \n0 102 30.5 \n0 0 1 \n0 0 0\n0 0 1 \n-1 0 0 \n0 -1 0 \n1 2 3 \n80 60 \n"
    (folder / f"{name}.camera").write_text(rows if text is None else text)


class TestStrecha:
    """The EPFL layout."""

    def test_truth_is_scaled_to_the_pictures_and_only_the_references(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images", NAMES[:3], gps=True)
        for name in NAMES[:2]:
            truth(tmp_path / "gt_dense_cameras", name)
        capture = open_capture(tmp_path)
        assert capture.reference is not None
        assert [frame.cam_from_world is None for frame in capture.reference.frames] == [False, False, True]
        first, second, third = capture.reference.frames
        assert first.camera_id == second.camera_id != third.camera_id
        assert capture.reference.camera_of(first) == ColmapCamera("PINHOLE", 40, 30, (50.0, 51.0, 20.5, 15.25))
        assert first.cam_from_world is not None
        np.testing.assert_allclose(first.cam_from_world.centre, [1, 2, 3], atol=1e-15)
        # Columns of the stored rotation are the camera's axes in the world: z forward is world x.
        np.testing.assert_allclose(first.cam_from_world.apply([[6.0, 2.0, 3.0]]), [[0, 0, 5]], atol=1e-14)
        np.testing.assert_allclose(first.cam_from_world.apply([[1.0, 2.0, 2.0]]), [[0, 1, 0]], atol=1e-14)
        assert capture.reference.georeference is None
        assert capture.scene.georeference is not None
        assert capture.scene.registered == ()
        assert isinstance(capture.scene.cameras[1], ColmapCamera)
        assert capture.scene.cameras[1].params[0] == 48.0

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("", r"1\.jpg\.camera; expected 26 finite numbers; found 0 numbers"),
            ("1 2 x", r"Cannot read .*1\.jpg\.camera; expected a camera of the EPFL benchmark"),
            ("nan " * 26, r"expected 26 finite numbers"),
            ("1 " * 26, r"is no camera of the EPFL benchmark; expected no distortion and a rotation"),
            (
                "9 0 1 0 9 1 0 0 1  0 0 0  1 0 0 0 1 0 0 0 1  0 0 0  80 80",
                r"belongs to a picture of another shape; expected 40x30 or a multiple; found 80x80",
            ),
            (
                "9 0 1 0 9 1 0 0 1  0 0 0  1 0 0 0 1 0 0 0 1  0 0 0  1e9 60",
                r"camera in .*1\.jpg\.camera has an impossible size",
            ),
            ("0 0 1 0 9 1 0 0 1  0 0 0  1 0 0 0 1 0 0 0 1  0 0 0  80 60", r"is damaged; found .*focal length"),
        ],
    )
    def test_damaged_truth_is_named(self, tmp_path: Path, text: str, message: str) -> None:
        pictures(tmp_path / "images", NAMES[:1])
        truth(tmp_path / "gt_dense_cameras", "1.jpg", text)
        with pytest.raises(DataError, match=message):
            open_capture(tmp_path)

    def test_truth_of_no_picture_is_an_error(self, tmp_path: Path) -> None:
        pictures(tmp_path / "images", NAMES[:1])
        truth(tmp_path / "gt_dense_cameras", "x.jpg")
        with pytest.raises(DataError, match=r"No camera in .*gt_dense_cameras belongs to a picture"):
            open_capture(tmp_path)


def test_photos_alone_have_no_reference(tmp_path: Path) -> None:
    pictures(tmp_path, gps=True)
    events: list[ProgressEvent] = []
    capture = open_capture(tmp_path, progress=events.append)
    assert capture.reference is None
    assert held_out(capture.scene) == ["1.jpg", "6.jpg"]
    assert events[-1].done == 12


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"Folder .*gone is missing; expected a folder with pictures or a scene"):
        open_capture(tmp_path / "gone")


# --------------------------------------------------------------------------------------------------- fingerprint


def test_the_fingerprint_tells_what_a_method_could_see(tmp_path: Path) -> None:
    scene = open_capture(pictures(tmp_path / "a", gps=True)).scene
    first = capture_fingerprint(scene)
    assert len(first) == 64
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    assert capture_fingerprint(open_capture(tmp_path / "b").scene) == first, "it depends on the place"
    assert capture_fingerprint(scene.replace(points=posed(tmp_path).points)) == first, "it depends on points"

    def changed(**change: object) -> Scene:
        return scene.replace(frames=(dataclasses.replace(scene.frames[0], **change), *scene.frames[1:]))

    others = [
        changed(split="train"),
        changed(time=1.0),
        changed(prior=None),
        changed(prior=PosePrior(position=np.array([0.0, 0.0, 1e-9]))),
        scene.replace(frames=scene.frames[::-1]),
        scene.replace(cameras={1: dataclasses.replace(CAMERA, prior_focal_length=True)}),
        scene.replace(cameras={1: CAMERA}),
        scene.replace(georeference=None),
    ]
    Image.new("RGB", (40, 30)).save(tmp_path / "b/12.jpg")
    others.append(open_capture(tmp_path / "b").scene)
    (tmp_path / "b/12.jpg").write_bytes((tmp_path / "a/12.jpg").read_bytes())
    (tmp_path / "b/masks").mkdir()
    Image.new("L", (40, 30)).save(tmp_path / "b/masks/1.jpg.png")
    others.append(open_capture(tmp_path / "b").scene)
    assert len({first, *(capture_fingerprint(other) for other in others)}) == 1 + len(others)


def test_the_fingerprint_survives_the_scene_folder(tmp_path: Path) -> None:
    scene = open_capture(pictures(tmp_path / "a", gps=True)).scene
    write_scene(scene, tmp_path / "b", copy_images=True)
    assert capture_fingerprint(open_capture(tmp_path / "b").scene) == capture_fingerprint(scene)
    assert json.loads((tmp_path / "b/scene.json").read_text())["image_dir"] == "images"


def test_the_fingerprint_needs_pictures_and_known_cameras_and_can_be_cancelled(tmp_path: Path) -> None:
    scene = open_capture(pictures(tmp_path, NAMES[:2])).scene
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        capture_fingerprint(scene, progress=token)
    with pytest.raises(CapabilityError, match="camera cannot be written"):
        capture_fingerprint(scene.replace(cameras={1: Unknown()}))
    (tmp_path / "2.jpg").unlink()
    with pytest.raises(DataError, match=r"Picture .*2\.jpg is missing"):
        capture_fingerprint(scene)


class Unknown:
    """A camera that is none of COLMAP's."""

    width = 40
    height = 30

    def project(self, points: object) -> np.ndarray:
        return np.zeros((0, 2))

    def ray(self, pixels: object) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((0, 3)), np.zeros((0, 3))
