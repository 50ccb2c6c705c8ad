"""nerfstudio's transforms.json: written, read back, made by hand, cut off and damaged."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from random_scenes import OtherCamera, random_scene, small_scene
from scipy.spatial.transform import Rotation

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.scene import Frame, Points, Scene, transforms
from toolkit.scene.ply import write_points
from toolkit.scene.transforms import read_transforms, write_transforms

#: Every model that the file holds, with the name that it reads back as.
CAMERAS = (
    ColmapCamera("SIMPLE_PINHOLE", 64, 48, (50.0, 32.0, 24.0)),
    ColmapCamera("PINHOLE", 64, 48, (50.0, 51.5, 32.25, 24.0)),
    ColmapCamera("SIMPLE_RADIAL", 640, 480, (1000 / 3, 320.1, 239.9, -0.01)),
    ColmapCamera("RADIAL", 640, 480, (500.0, 320.1, 239.9, -0.01, 1e-17)),
    ColmapCamera("OPENCV", 640, 480, (500.0, 501.0, 320.1, 239.9, -0.01, 0.02, 1e-3, -1e-3)),
    ColmapCamera("FULL_OPENCV", 100, 100, (100.0, 101.0, 50.0, 50.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0)),
    ColmapCamera("OPENCV_FISHEYE", 1, 2, (1e-3, 1e5, 0.5, 1.0, 1e-300, -1e-17, 0.0, 2.0)),
)
#: The camera at (1, 2, 3) that looks along world +x with world z up: right is -y, up is z, back is -x.
LOOKS_ALONG_X = [[0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def record(**changes: Any) -> dict[str, Any]:
    """Return two frames that share a camera, with some keys of the file changed or, by None, taken out."""
    frames = [
        {"file_path": f"images/{name}.jpg", "transform_matrix": copy.deepcopy(LOOKS_ALONG_X)} for name in "ab"
    ]
    made = {"fl_x": 50.0, "fl_y": 51.0, "cx": 20.5, "cy": 15.0, "w": 40, "h": 30, "frames": frames, **changes}
    return {key: value for key, value in made.items() if value is not None}


def written(place: Path, value: object) -> Path:
    place.mkdir(parents=True, exist_ok=True)
    (place / "transforms.json").write_text(value if isinstance(value, str) else json.dumps(value))
    return place / "transforms.json"


def with_frame(**changes: Any) -> dict[str, Any]:
    """Return the record with some keys of its second frame changed or, by None, taken out."""
    made = record()
    frame = {**made["frames"][1], **changes}
    made["frames"][1] = {key: value for key, value in frame.items() if value is not None}
    return made


# --------------------------------------------------------------------------------------------------- round trips


def representable(seed: int, place: Path) -> Scene:
    """Return a random scene with cameras that the file can hold and at least one pose."""
    scene = random_scene(seed, place)
    rng = np.random.default_rng(seed)
    cameras = {number: CAMERAS[rng.integers(len(CAMERAS))] for number in scene.cameras}
    anchor = Frame(
        "anchor.png", min(cameras), RigidTransform(Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
    )
    return scene.replace(cameras=cameras, frames=(*scene.frames, anchor), mask_dir=None)


def assert_same_poses(found: Scene, expected: Scene) -> None:
    for one, other in zip(found.frames, expected.registered, strict=True):
        assert one.cam_from_world is not None
        assert other.cam_from_world is not None
        np.testing.assert_allclose(one.cam_from_world.rotation, other.cam_from_world.rotation, rtol=0, atol=1e-14)
        # Turned round twice: a few roundings of the largest number.
        size = float(np.linalg.norm(other.cam_from_world.translation))
        np.testing.assert_allclose(
            one.cam_from_world.translation, other.cam_from_world.translation, rtol=0, atol=1e-14 * size
        )


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_a_scene_survives_its_file(seed: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        scene = representable(seed, place)
        write_transforms(scene, place / "transforms.json")
        found = read_transforms(place / "transforms.json")
        assert found.image_dir == place
        assert [frame.name for frame in found.frames] == [frame.name for frame in scene.registered]
        assert [frame.split for frame in found.frames] == [frame.split for frame in scene.registered]
        assert [found.camera_of(f) for f in found.frames] == [scene.camera_of(f) for f in scene.registered]
        assert_same_poses(found, scene)
        if scene.points is None or not len(scene.points):
            assert found.points is None
        else:
            assert found.points is not None
            np.testing.assert_array_equal(found.points.xyz, scene.points.xyz)
            np.testing.assert_array_equal(found.points.rgb, scene.points.rgb)


def test_one_camera_stands_at_the_top_and_several_in_their_frames(tmp_path: Path) -> None:
    scene = small_scene().replace(image_dir=tmp_path)
    write_transforms(scene, tmp_path / "two.json")
    two = json.loads((tmp_path / "two.json").read_text())
    assert "fl_x" not in two
    assert [frame["camera_model"] for frame in two["frames"]] == ["PINHOLE", "SIMPLE_RADIAL"]
    write_transforms(scene.replace(frames=scene.frames[:1], points=None), tmp_path / "one.json")
    found = json.loads((tmp_path / "one.json").read_text())
    keys = {"camera_model": "PINHOLE", "w": 64, "h": 48, "fl_x": 50.0, "fl_y": 51.5, "cx": 32.0, "cy": 24.0}
    assert {key: found[key] for key in keys} == keys
    assert set(found["frames"][0]) == {"file_path", "transform_matrix"}


def test_pictures_and_masks_below_the_folder_are_named_relative_to_it(tmp_path: Path) -> None:
    scene = small_scene().replace(image_dir=tmp_path / "images")
    write_transforms(scene, tmp_path / "transforms.json")
    found = read_transforms(tmp_path / "transforms.json")
    assert [frame.name for frame in found.frames] == ["images/a.jpg", "images/c.jpg"]
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/a.jpg.png").write_bytes(b"mask")
    beside = small_scene().replace(image_dir=tmp_path, mask_dir=tmp_path / "masks")
    write_transforms(beside, tmp_path / "transforms.json")
    found = read_transforms(tmp_path / "transforms.json")
    assert found.mask_path(found.frames[0]) == tmp_path / "masks/a.jpg.png"
    assert found.mask_path(found.frames[1]) is None


def test_what_the_file_cannot_hold_is_refused(tmp_path: Path) -> None:
    scene, path = small_scene().replace(image_dir=tmp_path), tmp_path / "transforms.json"
    thin = ColmapCamera("THIN_PRISM_FISHEYE", 10, 10, (5.0,) * 4 + (0.0,) * 8)
    rational = dataclasses.replace(CAMERAS[5], params=(*CAMERAS[5].params[:-1], 0.1))
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/a.jpg.png").write_bytes(b"mask")
    for changed, message in (
        (
            scene.replace(cameras={1: thin, 2: thin, 9: thin}),
            "expected SIMPLE_PINHOLE, .*; found THIN_PRISM_FISHEYE",
        ),
        (
            scene.replace(cameras=dict.fromkeys((1, 2, 9), rational)),
            r"FULL_OPENCV without k4, k5 and k6; .* Undistort",
        ),
        (scene.replace(cameras={i: OtherCamera() for i in (1, 2, 9)}), "found OtherCamera"),
        (scene.replace(image_dir=tmp_path.parent), "Pictures cannot be named in .*; expected a folder in"),
        (
            scene.replace(image_dir=tmp_path / "images", mask_dir=tmp_path / "masks"),
            r"Masks cannot be named in transforms\.json; expected a folder with 'images/a\.jpg\.png'",
        ),
    ):
        with pytest.raises(CapabilityError, match=message):
            write_transforms(changed, path)
    infinite = RigidTransform(np.eye(3), np.array([0.0, np.inf, 0.0]))
    for frames, message in (
        ((), "expected frames with a pose; found none of 0"),
        ((dataclasses.replace(scene.frames[0], cam_from_world=None),), "found none of 1"),
        ((dataclasses.replace(scene.frames[0], cam_from_world=infinite),), r"frame 'a\.jpg' is not finite"),
        ((dataclasses.replace(scene.frames[0], name="a\n.jpg"),), "cannot be stored"),
    ):
        with pytest.raises(DataError, match=message), np.errstate(invalid="ignore"):
            write_transforms(scene.replace(frames=frames, points=None), path)
    assert not path.exists()


# ---------------------------------------------------------------------------------------------------- conventions


def test_axes_are_opengls_and_pixels_colmaps(tmp_path: Path) -> None:
    scene = read_transforms(written(tmp_path, record()))
    frame = scene.frames[0]
    assert frame.cam_from_world is not None
    np.testing.assert_allclose(frame.cam_from_world.centre, [1, 2, 3], atol=1e-15)
    # Five ahead is world +x; one to the left of it is world +y; one below is world -z.
    seen = frame.cam_from_world.apply([[6.0, 2.0, 3.0], [6.0, 3.0, 3.0], [6.0, 2.0, 2.0]])
    np.testing.assert_allclose(seen, [[0, 0, 5], [-1, 0, 5], [0, 1, 5]], atol=1e-15)
    np.testing.assert_allclose(scene.camera_of(frame).project(seen), [[20.5, 15], [10.5, 15], [20.5, 25.2]])
    assert scene.cameras == {1: ColmapCamera("PINHOLE", 40, 30, (50.0, 51.0, 20.5, 15.0))}
    camera = scene.cameras[1]
    assert isinstance(camera, ColmapCamera)
    assert camera.prior_focal_length
    assert {f.split for f in scene.frames} == {"train"}


def test_the_applied_transform_is_undone_for_poses_and_points(tmp_path: Path) -> None:
    # What ns-process-data does to COLMAP's world, and a shift and a scale.
    applied = np.array([[1.0, 0, 0, 10], [0, 0, 1, 20], [0, -1, 0, 30]])
    scale = 4.0
    write_points(Points(np.array([[1.0, 2.0, 3.0]]), np.array([[1, 2, 3]], np.uint8)), tmp_path / "plain.ply")
    write_points(
        Points(scale * (np.array([[1.0, 3.0, -2.0]]) + applied[:, 3]), np.array([[1, 2, 3]], np.uint8)),
        tmp_path / "saved.ply",
    )
    saved = np.array(LOOKS_ALONG_X)
    saved[:3] = applied @ saved
    saved[:3, 3] *= scale
    plain = read_transforms(written(tmp_path, record(ply_file_path="plain.ply")))
    for rows in (3, 4):
        matrix = np.vstack([applied, [0, 0, 0, 1]])[:rows].tolist()
        made = record(applied_transform=matrix, applied_scale=scale, ply_file_path="saved.ply")
        made["frames"][0]["transform_matrix"] = saved.tolist()
        found = read_transforms(written(tmp_path, made))
        one, other = found.frames[0].cam_from_world, plain.frames[0].cam_from_world
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-13)
        assert found.points is not None
        assert plain.points is not None
        np.testing.assert_allclose(found.points.xyz, plain.points.xyz, atol=1e-13)
        np.testing.assert_array_equal(found.points.rgb, [[1, 2, 3]])


def test_few_digits_are_taken_to_the_nearest_rotation(tmp_path: Path) -> None:
    rotation = np.round(Rotation.from_euler("xyz", [0.3, 0.2, 0.1]).as_matrix(), 4)
    made = with_frame(transform_matrix=[[*row, 1.0] for row in rotation.tolist()] + [[0, 0, 0, 1]])
    pose = read_transforms(written(tmp_path, made)).frames[1].cam_from_world
    assert pose is not None
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ({}, ColmapCamera("PINHOLE", 40, 30, (50.0, 51.0, 20.5, 15.0))),
        ({"fl_y": None, "cx": None}, ColmapCamera("PINHOLE", 40, 30, (50.0, 50.0, 20.0, 15.0))),
        ({"fl_x": None}, ColmapCamera("PINHOLE", 40, 30, (51.0, 51.0, 20.5, 15.0))),
        ({"w": 40.0, "h": 30.0}, ColmapCamera("PINHOLE", 40, 30, (50.0, 51.0, 20.5, 15.0))),
        ({"camera_model": "SIMPLE_PINHOLE"}, ColmapCamera("PINHOLE", 40, 30, (50.0, 51.0, 20.5, 15.0))),
        (
            {"camera_model": "SIMPLE_PINHOLE", "fl_y": 50},
            ColmapCamera("SIMPLE_PINHOLE", 40, 30, (50.0, 20.5, 15.0)),
        ),
        ({"k1": 0.1}, ColmapCamera("OPENCV", 40, 30, (50.0, 51.0, 20.5, 15.0, 0.1, 0, 0, 0))),
        ({"camera_model": "PINHOLE", "p2": 0.1}, ColmapCamera("OPENCV", 40, 30, (50, 51, 20.5, 15, 0, 0, 0, 0.1))),
        ({"camera_model": "OPENCV"}, ColmapCamera("OPENCV", 40, 30, (50.0, 51.0, 20.5, 15.0, 0, 0, 0, 0))),
        (
            {"camera_model": "OPENCV", "k1": 0.1, "k3": 0.3},
            ColmapCamera("FULL_OPENCV", 40, 30, (50.0, 51.0, 20.5, 15.0, 0.1, 0, 0, 0, 0.3, 0, 0, 0)),
        ),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.4},
            ColmapCamera("OPENCV_FISHEYE", 40, 30, (50.0, 51.0, 20.5, 15.0, 0.1, 0, 0, 0.4)),
        ),
        (
            {"fl_x": None, "fl_y": None, "camera_angle_x": math.pi / 2},
            ColmapCamera("PINHOLE", 40, 30, (20 / math.tan(math.pi / 4),) * 2 + (20.5, 15.0)),
        ),
        (
            {"fl_x": None, "fl_y": None, "camera_angle_x": math.pi / 2, "camera_angle_y": 1.0},
            ColmapCamera("PINHOLE", 40, 30, (20 / math.tan(math.pi / 4), 15 / math.tan(0.5), 20.5, 15.0)),
        ),
    ],
)
def test_cameras(tmp_path: Path, keys: dict[str, Any], expected: ColmapCamera) -> None:
    (camera,) = read_transforms(written(tmp_path, record(**keys))).cameras.values()
    assert isinstance(camera, ColmapCamera)
    assert (camera.model, camera.width, camera.height) == (expected.model, expected.width, expected.height)
    np.testing.assert_allclose(camera.params, expected.params, rtol=1e-15)


def test_a_frames_own_keys_count_before_the_files(tmp_path: Path) -> None:
    scene = read_transforms(written(tmp_path, with_frame(fl_x=70.0, k1=0.5, w=41)))
    own = ColmapCamera("OPENCV", 41, 30, (70.0, 51.0, 20.5, 15.0, 0.5, 0, 0, 0))
    assert scene.cameras == {1: ColmapCamera("PINHOLE", 40, 30, (50.0, 51.0, 20.5, 15.0)), 2: own}
    assert scene.camera_of(scene.frames[1]) == own
    scene = read_transforms(written(tmp_path, with_frame(camera_angle_x=math.pi / 2)))
    camera = scene.camera_of(scene.frames[1])
    assert isinstance(camera, ColmapCamera)
    np.testing.assert_allclose(camera.params[:2], 20)


def test_the_picture_tells_its_size_and_blenders_names_get_their_ending(tmp_path: Path) -> None:
    (tmp_path / "train").mkdir()
    for name in ("r_0.png", "r_1.5.png", "odd"):
        Image.new("RGB", (40, 30)).save(tmp_path / "train" / name, format="PNG")
    frames = [
        {"file_path": f"./train/{name}", "transform_matrix": LOOKS_ALONG_X} for name in ("r_0", "r_1.5", "odd")
    ]
    made = {"camera_angle_x": math.pi / 2, "frames": frames, "test_filenames": ["./train/r_1.5"]}
    scene = read_transforms(written(tmp_path, made))
    assert [frame.name for frame in scene.frames] == ["train/r_0.png", "train/r_1.5.png", "train/odd"]
    assert [frame.split for frame in scene.frames] == ["train", "test", "train"]
    (camera,) = scene.cameras.values()
    assert isinstance(camera, ColmapCamera)
    np.testing.assert_allclose(camera.params, (20, 20, 20, 15))
    (tmp_path / "train/r_0.png").unlink()
    with pytest.raises(DataError, match=r"Picture .*r_0\.png is missing"):
        read_transforms(tmp_path / "transforms.json")


@pytest.mark.parametrize(
    ("lists", "expected"),
    [
        ({"test_filenames": ["images/b.jpg"]}, ["train", "test"]),
        ({"val_filenames": ["./images/a.jpg"]}, ["test", "train"]),
        ({"train_filenames": ["images/a.jpg"]}, ["train", "test"]),
        ({"train_filenames": ["images/a.jpg"], "val_filenames": [], "test_filenames": []}, ["train", "test"]),
        ({"train_filenames": [], "val_filenames": ["images/a.jpg"], "test_filenames": None}, ["test", "test"]),
    ],
)
def test_splits(tmp_path: Path, lists: dict[str, Any], expected: list[str]) -> None:
    scene = read_transforms(written(tmp_path, record(**lists)))
    assert [frame.split for frame in scene.frames] == expected


def test_masks_are_found_below_one_folder(tmp_path: Path) -> None:
    path = written(tmp_path, with_frame(mask_path="cut/out/images/b.jpg.png"))
    with pytest.raises(DataError, match=r"The mask of .*frame 1 \('images/b\.jpg'\) is missing"):
        read_transforms(path)
    (tmp_path / "cut/out/images").mkdir(parents=True)
    (tmp_path / "cut/out/images/b.jpg.png").write_bytes(b"mask")
    scene = read_transforms(path)
    assert scene.mask_dir == tmp_path / "cut/out"
    assert [scene.mask_path(frame) is None for frame in scene.frames] == [True, False]


# --------------------------------------------------------------------------------------------------------- errors


def matrix(row: int, column: int, value: object) -> list[list[Any]]:
    rows: list[list[Any]] = [list(numbers) for numbers in LOOKS_ALONG_X]
    rows[row][column] = value
    return rows


WHERE = r".*transforms\.json, frame 1 \('images/b\.jpg'\)"


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("", r"Cannot read .*transforms\.json; expected a JSON file"),
        ("[" * 100000, r"Cannot read .*transforms\.json"),
        ('{"frames": ' + "1" * 5000 + "}", r"Cannot read .*transforms\.json; expected a JSON file; found Exceeds"),
        ("[]", r"Cannot read 'frames' in .*transforms\.json; expected list; found None"),
        ({"frames": {}}, r"Cannot read 'frames' in .*; expected list; found \{\}"),
        ({"frames": []}, r"transforms\.json has no frames; expected at least one"),
        ({"frames": [3]}, r"Cannot read 'file_path' in .*frame 0; expected str; found None"),
        (
            with_frame(file_path=None),
            r"Cannot read 'file_path' in .*transforms\.json, frame 1; expected str; found None",
        ),
        (with_frame(file_path=7), r"Cannot read 'file_path' in .*frame 1; expected str; found 7"),
        (with_frame(file_path="../b.jpg"), r"'file_path' of .*frame 1 leaves the folder .*; found '\.\./b\.jpg'"),
        (with_frame(file_path="a/../b.jpg"), r"leaves the folder"),
        (with_frame(file_path="a\\..\\..\\b.jpg"), r"leaves the folder"),
        (with_frame(file_path="/etc/b.jpg"), r"leaves the folder .*; expected a path below it"),
        (with_frame(file_path=""), r"leaves the folder"),
        (with_frame(file_path="a\0.jpg"), r"cannot be stored"),
        (with_frame(file_path="\ud800.jpg"), r"cannot be stored"),
        (with_frame(file_path="a" * 300), r"'file_path' of .*frame 1 is too long"),
        (with_frame(file_path="a/" * 900 + "b"), r"'file_path' of .*frame 1 is too long"),
        (
            with_frame(file_path="./images//a.jpg"),
            r"two frames of one 'file_path'; .* 'images/a\.jpg' in frames 0 and 1",
        ),
        (with_frame(transform_matrix=None), rf"Cannot read 'transform_matrix' in {WHERE}; expected list"),
        (with_frame(transform_matrix="x"), rf"Cannot read 'transform_matrix' in {WHERE}; expected list; found 'x'"),
        (
            with_frame(transform_matrix=[[1.0]]),
            rf"Cannot read the 'transform_matrix' of {WHERE}; expected \(4, 4\)",
        ),
        (with_frame(transform_matrix=LOOKS_ALONG_X[:3]), r"expected \(4, 4\) numbers"),
        (with_frame(transform_matrix=matrix(0, 0, math.nan)), rf"'transform_matrix' of {WHERE}; expected a finite"),
        (with_frame(transform_matrix=matrix(0, 3, math.inf)), r"expected a finite number; found inf"),
        (with_frame(transform_matrix=matrix(0, 3, 10**400)), r"expected a finite number; found 1000"),
        (with_frame(transform_matrix=matrix(0, 0, "1")), r"expected a finite number; found '1'"),
        (with_frame(transform_matrix=matrix(0, 0, True)), r"expected a finite number; found True"),
        (with_frame(transform_matrix=matrix(0, 0, 0.1)), rf"'transform_matrix' of {WHERE} is none; .* rows off by"),
        (
            with_frame(transform_matrix=matrix(0, 0, 1e200)),
            r"orthonormal rows within 0\.001; found rows off by inf",
        ),
        (with_frame(transform_matrix=matrix(2, 1, -1.0)), r"determinant 1; found a mirror"),
        (
            with_frame(transform_matrix=matrix(3, 0, 0.1)),
            rf"'transform_matrix' of {WHERE} is no rigid motion; .* last row",
        ),
        (record(w=None), r"Picture .*images/a\.jpg is missing"),
        (record(w=40.5), r"Cannot read 'w' in .*frame 0 .*; expected a whole number of pixels; found 40\.5"),
        (record(h="30"), r"Cannot read 'h' in .*; expected int or float; found '30'"),
        (record(h=0), r"camera in .*frame 0 .* has an impossible size"),
        (record(w=10**400), r"Cannot read the 'w' of"),
        (
            record(fl_x=None, fl_y=None),
            r"No focal length in .*frame 0 .*; expected 'fl_x' and 'fl_y', or 'camera_angle_x'",
        ),
        (record(fl_x="50"), r"Cannot read the 'fl_x' of .*frame 0 .*; expected a finite number; found '50'"),
        (record(fl_x=-50), r"The camera in .*frame 0 .* is damaged; .* no focal length"),
        (record(fl_x=None, camera_angle_x=4.0), r"Impossible 'camera_angle_x' in .*; expected radians, .* found 4"),
        (record(fl_x=None, camera_angle_x=0), r"Impossible 'camera_angle_x'"),
        (record(fl_x=None, camera_angle_x=1e-320), r"Impossible 'camera_angle_x'"),
        (with_frame(k1=math.nan), rf"Cannot read the 'k1' of {WHERE}; expected a finite number; found nan"),
        (with_frame(k4=0.1), rf"The distortion in {WHERE} belongs to no camera model; .*; found k4 0\.1"),
        (record(camera_model="OPENCV_FISHEYE", p1=0.1), r"belongs to no camera model; .*; found p1 0\.1"),
        (
            record(camera_model="EQUIRECTANGULAR"),
            r"Unknown 'camera_model' in .*frame 0 .*; expected SIMPLE_PINHOLE, .*",
        ),
        (record(camera_model=3), r"Cannot read 'camera_model' in .*; expected str; found 3"),
        (record(applied_transform="x"), r"Cannot read 'applied_transform' in .*transforms\.json; expected list"),
        (record(applied_transform=[[1, 2], [3, 4]]), r"'applied_transform' of .*; expected \(3, 4\) numbers"),
        (
            record(applied_transform=[[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]),
            r"'applied_transform' of .* is none",
        ),
        (record(applied_transform=[[0] * 4] * 4), r"'applied_transform' of .* is no rigid motion"),
        (record(applied_scale=0), r"Impossible 'applied_scale' in .*; expected a positive number; found 0"),
        (record(applied_scale="1"), r"'applied_scale' of .*; expected a finite number"),
        (record(applied_scale=1e-320), r"'transform_matrix' of .*frame 0 .* is too large"),
        (record(test_filenames="b"), r"Cannot read 'test_filenames' in .*; expected list; found 'b'"),
        (record(test_filenames=[3]), r"Cannot read 'test_filenames' in .*; expected a list of paths; found 3"),
        (
            record(test_filenames=["c.jpg"]),
            r"'test_filenames' in .* names pictures that are in no frame; found c\.jpg",
        ),
        (record(val_filenames=["../c.jpg"]), r"'val_filenames' of .* leaves the folder"),
        (
            record(train_filenames=["images/a.jpg"], val_filenames=["images/a.jpg"]),
            r"has frames to train on and to test with; .*; found images/a\.jpg\. Take them out of one",
        ),
        (with_frame(mask_path=3), rf"Cannot read 'mask_path' in {WHERE}; expected str; found 3"),
        (
            with_frame(mask_path="masks/b.png"),
            r"expected 'masks/images/b\.jpg\.png'; found 'masks/b\.png'\. Rename",
        ),
        (with_frame(mask_path="../images/b.jpg.png"), r"'mask_path' of .* leaves the folder"),
        (record(ply_file_path=3), r"Cannot read 'ply_file_path' in .*; expected str"),
        (record(ply_file_path="gone.ply"), r"gone\.ply is missing; expected a PLY file"),
        (record(ply_file_path="../a.ply"), r"'ply_file_path' of .* leaves the folder"),
    ],
)
def test_damage_is_named(tmp_path: Path, value: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_transforms(written(tmp_path, value))


def test_masks_of_two_folders_are_refused(tmp_path: Path) -> None:
    made = record()
    for frame, place in zip(made["frames"], ("one", "two"), strict=True):
        frame["mask_path"] = f"{place}/{frame['file_path']}.png"
        (tmp_path / place / "images").mkdir(parents=True)
        (tmp_path / frame["mask_path"]).write_bytes(b"mask")
    with pytest.raises(
        DataError, match=r"Cannot use the 'mask_path' .*; expected 'one/images/b\.jpg\.png'; found 'two"
    ):
        read_transforms(written(tmp_path, made))


def test_missing_and_too_large_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DataError, match=r"transforms\.json is missing; expected a JSON file"):
        read_transforms(tmp_path / "transforms.json")
    with pytest.raises(DataError, match="Cannot read"):
        read_transforms(tmp_path)
    path = written(tmp_path, record())
    monkeypatch.setattr(transforms, "_LARGEST_FILE", 100)
    with pytest.raises(DataError, match=r"transforms\.json is too large; expected at most"):
        read_transforms(path)


def test_cut_off_at_any_byte_is_an_error(tmp_path: Path) -> None:
    scene = small_scene().replace(image_dir=tmp_path)
    write_transforms(scene.replace(frames=scene.frames[:1], points=None), tmp_path / "transforms.json")
    text = (tmp_path / "transforms.json").read_text().rstrip("\n")
    for length in range(len(text)):
        with pytest.raises(DataError, match=r"Cannot read .*transforms\.json; expected a JSON file"):
            read_transforms(written(tmp_path, text[:length]))


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.sampled_from([[], {}, [[]]]),
    st.lists(st.lists(st.floats(width=16), min_size=4, max_size=4), min_size=3, max_size=4),
)
OTHER_KEYS = (
    "applied_scale",
    "applied_transform",
    "file_path",
    "frames",
    "mask_path",
    "ply_file_path",
    "train_filenames",
    "transform_matrix",
)


@settings(max_examples=150)
@given(st.sampled_from([*transforms.CAMERA_KEYS, *OTHER_KEYS]), JUNK, st.booleans())
def test_junk_is_a_scene_or_an_error_and_nothing_else(key: str, junk: object, inside: bool) -> None:
    made = with_frame(**{key: junk}) if inside else record(**{key: junk})
    with tempfile.TemporaryDirectory() as folder:
        path = written(Path(folder), made)
        try:
            outcome = str([frame.name for frame in read_transforms(path).frames])
        except DataError as error:
            outcome = str(error)
        assert outcome
