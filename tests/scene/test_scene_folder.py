"""A scene written as a folder and read back."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scenes import OtherCamera, assert_same_scene, random_scene, scenes, small_scene

from toolkit.errors import Cancelled, CapabilityError, DataError, RunError
from toolkit.geometry.rigid import RigidTransform
from toolkit.progress import CancelToken, ProgressEvent
from toolkit.scene import Frame, Georeference, PosePrior, Scene, colmap, folder
from toolkit.scene.folder import read_scene, write_scene


@settings(max_examples=80, deadline=None)
@given(scenes)
def test_a_scene_survives_its_folder(scene: Scene) -> None:
    with tempfile.TemporaryDirectory() as place:
        write_scene(scene, Path(place))
        assert_same_scene(read_scene(Path(place)), scene)


@settings(max_examples=20, deadline=None)
@given(scenes, scenes)
def test_writing_over_a_scene_leaves_nothing_of_the_old_one(old: Scene, new: Scene) -> None:
    with tempfile.TemporaryDirectory() as place:
        write_scene(old, Path(place))
        write_scene(new, Path(place))
        assert_same_scene(read_scene(Path(place)), new)


def test_points_without_any_pose_survive(tmp_path: Path) -> None:
    scene = small_scene()
    assert scene.points is not None
    scene = scene.without_poses().replace(points=dataclasses.replace(scene.points, tracks=None))
    write_scene(scene, tmp_path)
    assert_same_scene(read_scene(tmp_path), scene)


def test_without_poses_and_points_there_is_no_sparse_model(tmp_path: Path) -> None:
    write_scene(small_scene(), tmp_path)
    assert (tmp_path / "sparse/0/points3D.bin").exists()
    write_scene(small_scene().without_poses(), tmp_path)
    assert not list((tmp_path / "sparse/0").iterdir())
    assert json.loads((tmp_path / "scene.json").read_text())["sparse"] is None


def with_pictures(place: Path) -> Scene:
    """Return the small scene with files that stand for its pictures and a mask, below ``place``."""
    (place / "photos" / "deep").mkdir(parents=True)
    (place / "cut").mkdir()
    scene = small_scene()
    frames = (dataclasses.replace(scene.frames[0], name="deep/a.jpg"), *scene.frames[1:])
    for frame in frames:
        (place / "photos" / frame.name).write_bytes(frame.name.encode())
    (place / "cut" / "b.jpg.png").write_bytes(b"mask")
    return scene.replace(frames=frames, image_dir=place / "photos", mask_dir=place / "cut")


def test_pictures_that_lie_elsewhere_are_referred_to(tmp_path: Path) -> None:
    scene = with_pictures(tmp_path / "capture")
    write_scene(scene, tmp_path / "scene")
    (tmp_path / "scene").rename(tmp_path / "moved")
    again = read_scene(tmp_path / "moved")
    assert again.image_dir == scene.image_dir
    assert again.mask_path(again.frames[1]) == tmp_path / "capture/cut/b.jpg.png"


def test_pictures_inside_the_folder_move_with_it(tmp_path: Path) -> None:
    scene = with_pictures(tmp_path / "capture")
    write_scene(scene, tmp_path / "capture")
    (tmp_path / "capture").rename(tmp_path / "moved")
    again = read_scene(tmp_path / "moved")
    assert again.image_dir == tmp_path / "moved/photos"
    assert again.mask_dir == tmp_path / "moved/cut"


def test_copied_pictures_and_masks_make_the_folder_whole(tmp_path: Path) -> None:
    scene = with_pictures(tmp_path / "capture")
    events: list[ProgressEvent] = []
    write_scene(scene, tmp_path / "scene", copy_images=True, progress=events.append)
    shutil.rmtree(tmp_path / "capture")
    again = read_scene(tmp_path / "scene")
    assert again.image_dir == tmp_path / "scene/images"
    assert [again.image_path(frame).read_bytes() for frame in again.frames] == [b"deep/a.jpg", b"b.jpg", b"c.jpg"]
    mask = again.mask_path(again.frames[1])
    assert mask is not None
    assert mask.read_bytes() == b"mask"
    assert [event.done for event in events] == [0, 1, 2, 3]
    # Copying onto itself keeps the files.
    write_scene(again, tmp_path / "scene", copy_images=True)
    assert_same_scene(read_scene(tmp_path / "scene"), again)
    assert (tmp_path / "scene/images/b.jpg").read_bytes() == b"b.jpg"


def test_copying_can_be_cancelled_and_leaves_no_scene(tmp_path: Path) -> None:
    token = CancelToken()
    token.cancel()
    with pytest.raises(Cancelled):
        write_scene(with_pictures(tmp_path / "a"), tmp_path / "b", copy_images=True, progress=token)
    with pytest.raises(DataError, match=r"scene\.json is missing"):
        read_scene(tmp_path / "b")


def test_a_picture_to_copy_that_is_missing_is_named(tmp_path: Path) -> None:
    scene = with_pictures(tmp_path / "capture")
    (tmp_path / "capture/photos/c.jpg").unlink()
    with pytest.raises(DataError, match=r"Picture .*c\.jpg is missing\. Put it back or take it out"):
        write_scene(scene, tmp_path / "scene", copy_images=True)


def test_colmap_opens_the_folder(tmp_path: Path) -> None:
    write_scene(small_scene(), tmp_path)
    assert pycolmap.Reconstruction(str(tmp_path / "sparse/0")).num_reg_images() == 2


def test_poses_that_colmap_changed_since_count(tmp_path: Path) -> None:
    scene = small_scene()
    write_scene(scene, tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.ones(3)))
    model.write_binary(tmp_path / "sparse/0")
    again = read_scene(tmp_path)
    assert scene.points is not None
    assert again.points is not None
    np.testing.assert_allclose(again.points.xyz, scene.points.xyz * 2 + 1, rtol=1e-14)
    np.testing.assert_allclose(again.centres(), scene.centres() * 2 + 1, rtol=1e-10)
    assert again.frames[0].prior is not None


class Crash(BaseException):
    """Stands for a killed process."""


@pytest.mark.parametrize("where", ["copy_pictures", "write_json"])
def test_a_crash_in_the_middle_leaves_no_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    scene = with_pictures(tmp_path / "capture")
    write_scene(scene, tmp_path / "scene", copy_images=True)

    def crash(*_: object, **__: object) -> None:
        raise Crash

    monkeypatch.setattr(folder, where, crash)
    with pytest.raises(Crash):
        write_scene(scene, tmp_path / "scene", copy_images=True)
    with pytest.raises(DataError, match=r"scene\.json is missing; expected a JSON file"):
        read_scene(tmp_path / "scene")


def test_a_crash_between_the_models_files_leaves_no_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scene(small_scene(), tmp_path)

    def crash(self: Path, target: Path) -> None:
        raise Crash

    monkeypatch.setattr(Path, "replace", crash)
    with pytest.raises(Crash):
        write_scene(small_scene(), tmp_path)
    with pytest.raises(DataError, match=r"scene\.json is missing"):
        read_scene(tmp_path)


def test_a_full_disk_leaves_the_old_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scene(small_scene(), tmp_path)

    def half(place: Path) -> None:
        raise DataError("cut off")

    monkeypatch.setattr(colmap, "read_model", half)
    with pytest.raises(RunError, match="could not be written to its end"):
        write_scene(random_scene(1), tmp_path)
    monkeypatch.undo()
    assert_same_scene(read_scene(tmp_path), small_scene())


def odd(frame: Frame) -> Scene:
    scene = small_scene()
    return scene.replace(frames=(frame, *scene.frames[1:]))


@pytest.mark.parametrize(
    ("scene", "error", "message"),
    [
        (
            small_scene().replace(cameras={**small_scene().cameras, 9: OtherCamera()}),
            CapabilityError,
            r"camera cannot be written.*COLMAP's models.*OtherCamera",
        ),
        (odd(Frame("a.jpg", 1, time=float("nan"))), DataError, r"time of frame 'a\.jpg' is not finite; found nan"),
        (odd(Frame("a\n.jpg", 1)), DataError, r"cannot be stored.*Rename the picture"),
        (odd(Frame("\udcff.jpg", 1)), DataError, r"cannot be stored; expected a name without control characters"),
        (
            odd(Frame("a.jpg", 1, prior=PosePrior(position=np.array([1.0, np.inf, 0.0])))),
            DataError,
            r"prior of frame 'a\.jpg' cannot be written; expected \(3,\) finite numbers",
        ),
        (
            odd(Frame("a.jpg", 1, prior=PosePrior(rotation=np.zeros(3)))),
            DataError,
            r"prior of frame 'a\.jpg' cannot be written; expected \(3, 3\) finite numbers",
        ),
        (
            odd(Frame("a.jpg", 1, RigidTransform(np.zeros((3, 3)), np.zeros(3)))),
            DataError,
            r"pose of frame 'a\.jpg' is no rigid motion",
        ),
        (
            small_scene().replace(georeference=Georeference(0.0, np.nan, 0.0)),
            DataError,
            "georeference is not finite",
        ),
    ],
)
def test_what_cannot_be_stored_is_refused_before_the_old_scene_goes(
    tmp_path: Path, scene: Scene, error: type[Exception], message: str
) -> None:
    write_scene(small_scene(), tmp_path)
    with pytest.raises(error, match=message):
        write_scene(scene, tmp_path)
    assert_same_scene(read_scene(tmp_path), small_scene())


def test_a_file_in_the_place_of_the_folder_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"Something is in the way while writing .*file"):
        write_scene(small_scene(), tmp_path / "file")


# ----------------------------------------------------------------------------------------- hostile scene.json


def test_scene_json_cut_off_at_any_byte_is_an_error(tmp_path: Path) -> None:
    scene = small_scene()
    write_scene(scene.replace(frames=scene.frames[:1], cameras={1: scene.cameras[1]}, points=None), tmp_path)
    path = tmp_path / "scene.json"
    whole = path.read_bytes()
    # The last byte is the line break after the closing brace: without it nothing is missing.
    for length in range(len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"Cannot read .*scene\.json; expected a JSON file"):
            read_scene(tmp_path)


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to every value of nested JSON."""
    yield at
    for key, item in (
        value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    ):
        yield from places(item, (*at, key))


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.sampled_from([0, -1, 2**32, 2**70, 10**400, 0.5, float("nan"), float("inf"), -1e308, 1e308]),
    st.sampled_from(
        ["", "..", "../x", "a/../../x", "/abs", "\0", "\ud800", "train", "..\\x", "a.jpg", "PINHOLE", "NaN"]
    ),
    st.sampled_from([[], {}, [[]], [None] * 3, [1, 2, 3], [[1, 0, 0], [0, 1, 0], [0, 0, -1]], {"name": 1}]),
)


@settings(max_examples=250, deadline=None)
@given(data=st.data())
def test_junk_anywhere_in_scene_json_is_an_error_or_a_scene(data: st.DataObject, scene_folder: Path) -> None:
    record = json.loads((scene_folder / "whole.json").read_text())
    for _ in range(data.draw(st.integers(1, 2))):
        *way, last = data.draw(st.sampled_from([at for at in places(record) if at]))
        target = record
        for key in way:
            target = target[key]
        if data.draw(st.booleans()):
            target[last] = copy.deepcopy(data.draw(JUNK))
        else:
            del target[last]
    (scene_folder / "scene.json").write_text(json.dumps(record))
    try:
        scene = read_scene(scene_folder)
    except DataError:
        return
    for frame in scene.frames:
        assert ".." not in frame.name.replace("\\", "/").split("/")
        assert frame.split in ("train", "test")
        assert frame.time is None or np.isfinite(frame.time)
    with tempfile.TemporaryDirectory() as again:
        write_scene(scene, Path(again))


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("junk")
    scene = small_scene().replace(georeference=Georeference(1.0, 2.0, 3.0), mask_dir=place / "masks")
    full = PosePrior(np.ones(3), np.ones(3), np.eye(3), np.ones(3))
    scene = scene.replace(frames=(dataclasses.replace(scene.frames[0], prior=full), *scene.frames[1:]))
    write_scene(scene, place)
    (place / "scene.json").rename(place / "whole.json")
    return place


def change(record: Any, way: str, value: Any) -> None:
    *steps, last = (int(step) if step.isdecimal() else step for step in way.split("/"))
    for step in steps:
        record = record[step]
    record[last] = value


@pytest.mark.parametrize(
    ("way", "value", "message"),
    [
        (
            "format",
            "nerf",
            r"Cannot read .*expected format 'sightline-scene', version 1; found format 'nerf', version 1",
        ),
        ("version", 2, r"found format 'sightline-scene', version 2\. Was it written by a newer version"),
        ("version", True, r"Cannot read 'version' in .*scene\.json; expected int; found True"),
        ("frames", None, r"Cannot read 'frames' in .*; expected list; found None"),
        ("frames/0", 7, r"Cannot read 'name' in .*frame 0; expected str; found None"),
        ("frames/0/name", "../a.jpg", r"holds no scene; found Frame name '\.\./a\.jpg' leaves the image folder"),
        ("frames/0/name", "..\\a.jpg", r"'\.\.\\a\.jpg' in .*frame 0 leaves the image folder"),
        ("frames/0/name", "/etc/passwd", r"'/etc/passwd' leaves the image folder"),
        ("frames/0/name", "c.jpg", r"Two frames have the same name"),
        ("frames/0/name", "new.jpg", r"images that the scene does not have; .* found a\.jpg"),
        ("frames/0/camera", 5, r"Frame 'a\.jpg' has no camera; expected one of \[1, 2, 9\]; found 5"),
        ("frames/0/split", "val", r"Unknown split in .*frame 0; expected 'train' or 'test'; found 'val'"),
        ("frames/0/time", float("inf"), r"Cannot read the time of .*frame 0; expected a finite number"),
        ("frames/0/time", 10**400, r"Cannot read the time of .*frame 0; expected a finite number"),
        ("frames/0/prior/position", [1, 2], r"Cannot read the position of .*frame 0; expected \(3,\) numbers"),
        (
            "frames/0/prior/position",
            [1, 2, "3"],
            r"Cannot read the position of .*frame 0; expected a finite number",
        ),
        ("frames/0/prior/rotation", [[1, 0, 0]], r"Cannot read the rotation of .*; expected \(3, 3\) numbers"),
        (
            "frames/0/prior/rotation",
            [[1, 0, 0], [0, 1, 0], [0, 0, 2]],
            r"The rotation of .*frame 0 is none; expected orthonormal rows",
        ),
        ("cameras/0/id", 9, r"has camera 9 twice"),
        ("cameras/0/model", "PIN", r"camera in .*camera 1 is damaged; found Unknown camera model 'PIN'"),
        ("cameras/0/params", [1, 2, 3, None], r"Cannot read the params of .*camera 1; expected a finite number"),
        ("cameras/0/width", 2**40, r"has an impossible size"),
        ("georeference", {"latitude": 91, "longitude": 0, "altitude": 0}, r"no place on Earth; found 91\.0, 0\.0"),
        ("georeference", {"latitude": 1}, r"Cannot read 'longitude' in .*expected int or float; found None"),
        ("image_dir", "../elsewhere", r"folder named in .* leaves it; expected a path without '\.\.'"),
        ("mask_dir", "a/../../b", r"folder named in .* leaves it"),
    ],
)
def test_each_fault_of_scene_json_is_named(tmp_path: Path, way: str, value: Any, message: str) -> None:
    write_scene(small_scene().replace(georeference=Georeference(1.0, 2.0, 3.0)), tmp_path)
    path = tmp_path / "scene.json"
    record = json.loads(path.read_text())
    change(record, way, value)
    path.write_text(json.dumps(record))
    with pytest.raises(DataError, match=message):
        read_scene(tmp_path)


def test_a_lost_sparse_model_is_an_error_and_not_a_scene_without_poses(tmp_path: Path) -> None:
    write_scene(small_scene(), tmp_path)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.raises(DataError, match=r"No COLMAP model in .*sparse/0"):
        read_scene(tmp_path)


@pytest.mark.parametrize("text", ["", "[]", "null", "{}", "[" * 100_000, '{"format": "sightline-scene"}'])
def test_json_that_is_no_scene_is_an_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(DataError, match=r"Cannot read .*scene\.json"):
        read_scene(tmp_path)
