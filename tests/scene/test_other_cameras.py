"""Scenes with cameras that COLMAP does not have, affine and RPC, in a folder."""

from __future__ import annotations

import copy
import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scenes import CAMERAS, assert_same_arrays, assert_same_points, assert_same_poses, pose, small_scene
from rpc_samples import sample_rpc

from toolkit.errors import CapabilityError, DataError
from toolkit.geometry.affine_camera import AffineCamera
from toolkit.geometry.cameras import Camera
from toolkit.geometry.rigid import RigidTransform
from toolkit.geometry.rpc_camera import RpcCamera
from toolkit.scene import Frame, Georeference, Points, Scene, Tracks
from toolkit.scene.folder import read_scene, write_scene
from toolkit.scene.records import camera_from_record, camera_record

AFFINE = AffineCamera(400, 300, 1.97, -1 / 3, 2.01, 199.9, 1e5 / 7)
RPC = RpcCamera(sample_rpc(1), 400, 300, (43.26, 5.44, 100 / 3), (0.1, -1e-3, 2e-5, -3.3, 0.0, 1 / 7))


def mixed_scene(seed: int) -> Scene:
    """Return a scene with all three kinds of cameras, some frames without a pose, and points seen by any frame."""
    rng = np.random.default_rng(seed)
    cameras: dict[int, Camera] = {
        0: CAMERAS[1],
        3: AFFINE,
        4: dataclasses.replace(RPC, rpc=sample_rpc(seed), extrapolate=bool(seed % 2)),
        8: AffineCamera(7, 5, *rng.uniform(0.1, 9, 5)),
    }
    frames = []
    for index in range(int(rng.integers(0, 7))):
        number = int(rng.choice(list(cameras)))
        known = pose(rng) if number != 4 else RigidTransform.identity()
        frames.append(Frame(f"{index}.tif", number, known if rng.random() < 0.8 else None, time=float(index)))
    posed = [i for i, frame in enumerate(frames) if frame.cam_from_world is not None]
    points = None
    if rng.random() < 0.8:
        count = int(rng.integers(0, 9))
        length = int(rng.integers(0, 20)) if count and posed else 0
        row = np.sort(rng.integers(0, max(count, 1), length))
        # Of one point, observations by COLMAP's cameras come first in a folder.
        frame = rng.choice(posed, length) if length else np.zeros(0, np.int64)
        order = np.lexsort([[frames[i].camera_id != 0 for i in frame], row])
        tracks = Tracks(row[order], frame[order], rng.normal(size=(length, 2)) * 100)
        colours = rng.integers(0, 256, (count, 3)).astype(np.uint8)
        points = Points(rng.normal(size=(count, 3)) * 1e3, colours, rng.random(count), tracks)
    return Scene(Path("/pictures"), cameras, tuple(frames), points, georeference=Georeference(43.26, 5.44, 100 / 3))


def assert_same(one: Scene, other: Scene) -> None:
    assert dict(one.cameras) == dict(other.cameras)
    for number, camera in one.cameras.items():
        assert type(camera) is type(other.cameras[number])
    assert [(f.name, f.camera_id, f.time) for f in one.frames] == [
        (f.name, f.camera_id, f.time) for f in other.frames
    ]
    assert one.georeference == other.georeference
    assert_same_poses(one, other)
    assert_same_points(one.points, other.points)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_a_mixed_scene_survives_its_folder(seed: int) -> None:
    scene = mixed_scene(seed)
    with tempfile.TemporaryDirectory() as place:
        write_scene(scene, Path(place))
        assert_same(read_scene(Path(place)), scene)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_nothing_of_an_old_scene_is_left(old: int, new: int) -> None:
    with tempfile.TemporaryDirectory() as place:
        write_scene(mixed_scene(old), Path(place))
        write_scene(mixed_scene(new), Path(place))
        assert_same(read_scene(Path(place)), mixed_scene(new))


def satellites() -> Scene:
    """Return two RPC frames and an affine one that see three points, and a frame of COLMAP's that sees one."""
    frames = (
        Frame("a.tif", 1, RigidTransform.identity()),
        Frame("b.tif", 1, RigidTransform.identity()),
        Frame("c.tif", 2, pose(np.random.default_rng(5))),
        Frame("d.jpg", 3, pose(np.random.default_rng(6))),
    )
    pixel = np.arange(16.0).reshape(8, 2) / 3
    tracks = Tracks(np.array([0, 0, 0, 1, 1, 2, 2, 2]), np.array([0, 1, 2, 0, 1, 3, 1, 2]), pixel)
    cloud = Points(np.arange(9.0).reshape(3, 3) / 7, np.zeros((3, 3), np.uint8), None, tracks)
    return Scene(Path("/pictures"), {1: RPC, 2: AFFINE, 3: CAMERAS[0]}, frames, cloud)


def test_colmap_opens_what_is_its_own(tmp_path: Path) -> None:
    write_scene(satellites(), tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    assert [image.name for image in model.images.values()] == ["d.jpg"]
    assert model.num_points3D() == 3
    assert_same(read_scene(tmp_path), satellites())


def test_without_colmaps_cameras_the_points_are_there_all_the_same(tmp_path: Path) -> None:
    scene = satellites()
    only = scene.replace(frames=scene.frames[:3], points=None)
    write_scene(only, tmp_path)
    assert not (tmp_path / "sparse").exists()
    assert_same(read_scene(tmp_path), only)
    assert scene.points is not None
    rows = scene.points.tracks.frame != 3 if scene.points.tracks is not None else np.zeros(0, bool)
    seen = only.replace(points=scene.points.observed(rows))
    write_scene(seen, tmp_path)
    assert pycolmap.Reconstruction(str(tmp_path / "sparse/0")).num_points3D() == 3
    assert_same(read_scene(tmp_path), seen)


def test_points_that_colmap_moved_or_deleted_since_count(tmp_path: Path) -> None:
    write_scene(satellites(), tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    model.delete_point3D(1)
    model.transform(pycolmap.Sim3d(2.0, pycolmap.Rotation3d(), np.ones(3)))
    model.write_binary(tmp_path / "sparse/0")
    points = read_scene(tmp_path).points
    old = satellites().points
    assert points is not None
    assert old is not None
    assert points.tracks is not None
    assert old.tracks is not None
    np.testing.assert_allclose(points.xyz, old.xyz[1:] * 2 + 1, rtol=1e-14)
    assert points.tracks.point.tolist() == [0, 0, 1, 1, 1]
    assert points.tracks.frame.tolist() == [0, 1, 3, 1, 2]
    assert_same_arrays(points.tracks.pixel, old.tracks.pixel[3:])


def test_a_folder_of_colmaps_cameras_alone_is_as_it_was(tmp_path: Path) -> None:
    write_scene(small_scene(), tmp_path)
    record = json.loads((tmp_path / "scene.json").read_text())
    assert record["version"] == 1
    assert all("pose" not in frame for frame in record["frames"])
    assert not (tmp_path / "observations.safetensors").exists()
    # As written before there were other cameras.
    del record["observations"]
    (tmp_path / "scene.json").write_text(json.dumps(record))
    assert_same_poses(read_scene(tmp_path), small_scene())


def test_colmap_refuses_them_by_name() -> None:
    scene = satellites()
    with pytest.raises(CapabilityError, match=r"Camera 1 cannot be given to COLMAP; .*found RpcCamera"):
        scene.to_pycolmap()
    affine = scene.replace(frames=scene.frames[2:3], points=None)
    with pytest.raises(CapabilityError, match=r"Camera 2 cannot be given to COLMAP; .*found AffineCamera"):
        affine.to_pycolmap()


# ------------------------------------------------------------------------------------------------------- records


@settings(max_examples=60)
@given(
    st.lists(st.floats(-1e9, 1e9), min_size=3, max_size=3), st.lists(st.floats(1e-9, 1e9), min_size=2, max_size=2)
)
def test_an_affine_camera_survives_its_record_to_the_bit(free: list[float], scales: list[float]) -> None:
    camera = AffineCamera(31, 17, scales[0], free[0], scales[1], free[1], free[2])
    again = camera_from_record(json.loads(json.dumps(camera_record(camera))), "here")
    assert again == camera


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.lists(st.floats(-9, 9), min_size=2, max_size=2))
def test_an_rpc_camera_survives_its_record_to_the_bit(seed: int, bias: list[float]) -> None:
    camera = dataclasses.replace(RPC, rpc=sample_rpc(seed)).with_correction(bias)
    again = camera_from_record(json.loads(json.dumps(camera_record(camera))), "here")
    assert again == camera
    points = np.random.default_rng(seed).uniform(-50, 50, (5, 3))
    np.testing.assert_array_equal(again.project(points), camera.project(points))


def change(record: Any, way: str, value: Any) -> None:
    *steps, last = (int(step) if step.isdecimal() else step for step in way.split("/"))
    for step in steps:
        record = record[step]
    record[last] = value


@pytest.mark.parametrize(
    ("way", "value", "message"),
    [
        ("cameras/0/rpc", None, r"Cannot read 'rpc' in .*camera 1; expected dict; found None"),
        ("cameras/0/rpc/line_num", [1.0], r"camera 1 is damaged; found RPC's line_num has a wrong number of coeff"),
        ("cameras/0/rpc/line_num/3", float("nan"), r"Cannot read the line_num of the RPC of .*camera 1"),
        ("cameras/0/rpc/line_scale", 0, r"camera in .*camera 1 is damaged; found RPC has line_scale zero"),
        ("cameras/0/rpc/line_scale", "1", r"Cannot read 'line_scale' in .*; expected int or float; found '1'"),
        ("cameras/0/origin", [1, 2], r"The origin in .*camera 1 is no place on Earth; expected"),
        ("cameras/0/origin", [91, 2, 3], r"The origin in .*camera 1 is no place on Earth"),
        ("cameras/0/correction", [1, 2], r"camera 1 is damaged; found RPC camera's correction is wrong"),
        ("cameras/0/extrapolate", 1, r"Cannot read 'extrapolate' in .*; expected bool; found 1"),
        ("cameras/0/width", 0, r"camera 1 has an impossible size; .*found 0x300"),
        ("cameras/1/params", [1.0, 2.0], r"params of .*camera 2; expected fx, skew, fy, cx, cy; found 2 numbers"),
        ("cameras/1/params/0", -1.0, r"camera 2 is damaged; found Affine camera has no scale"),
        ("cameras/1/model", "AFFINITY", r"camera 2 is damaged; found Unknown camera model 'AFFINITY'"),
        ("frames/0/pose", [1, 0, 0], r"Cannot read the pose of .*frame 0; expected a quaternion"),
        ("frames/0/pose", [0, 0, 0, 0, 1, 2, 3], r"The pose in .*frame 0 is damaged; expected a unit quaternion"),
        ("frames/0/pose/5", "x", r"Cannot read the pose of .*frame 0; expected a finite number; found 'x'"),
    ],
)  # fmt: skip
def test_each_fault_of_scene_json_is_named(tmp_path: Path, way: str, value: Any, message: str) -> None:
    write_scene(satellites(), tmp_path)
    record = json.loads((tmp_path / "scene.json").read_text())
    change(record, way, value)
    (tmp_path / "scene.json").write_text(json.dumps(record))
    with pytest.raises(DataError, match=message):
        read_scene(tmp_path)


JUNK = [
    None,
    True,
    0,
    -1,
    2**70,
    10**400,
    float("nan"),
    1e308,
    "",
    "..",
    [],
    {},
    [[]],
    [0] * 7,
    {"line_num": 1},
    "RPC",
]


@settings(max_examples=150)
@given(data=st.data())
def test_junk_anywhere_is_an_error_or_a_scene(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    place = tmp_path_factory.mktemp("junk")
    write_scene(satellites(), place)
    record = json.loads((place / "scene.json").read_text())
    target: Any = record
    while True:
        keys = list(target) if isinstance(target, dict) else range(len(target))
        key = data.draw(st.sampled_from(list(keys)))
        inner = target[key]
        if not (isinstance(inner, dict | list) and inner and data.draw(st.booleans())):
            break
        target = inner
    target[key] = copy.deepcopy(data.draw(st.sampled_from(JUNK)))
    (place / "scene.json").write_text(json.dumps(record))
    try:
        scene = read_scene(place)
    except DataError:
        return
    write_scene(scene, place / "again")


@pytest.mark.parametrize("length", [0, 7, 50, -8, -1])
def test_observations_cut_off_are_an_error(tmp_path: Path, length: int) -> None:
    write_scene(satellites(), tmp_path)
    path = tmp_path / "observations.safetensors"
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(DataError, match=r"observations\.safetensors is cut off or damaged"):
        read_scene(tmp_path)
    path.unlink()
    with pytest.raises(
        DataError, match=r"observations\.safetensors is missing; expected the observations of the scene"
    ):
        read_scene(tmp_path)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("frame", np.full(7, 4), r"does not fit its scene; expected finite pixels in frames 0 to 3"),
        ("frame", np.full(7, -1), r"does not fit its scene"),
        ("pixel", np.full((7, 2), np.nan), r"does not fit its scene"),
        ("pixel", np.zeros((7, 3)), r"holds no observations; expected point_id \(T,\)"),
        ("pixel", np.zeros((6, 2)), r"holds no observations"),
        ("frame", np.zeros(7, np.int32), r"holds no observations"),
        ("more", np.zeros(7), r"holds no observations"),
    ],
)
def test_observations_that_contradict_the_scene_are_an_error(
    tmp_path: Path, name: str, value: np.ndarray, message: str
) -> None:
    from safetensors.numpy import load_file, save_file

    write_scene(satellites(), tmp_path)
    path = tmp_path / "observations.safetensors"
    save_file({**load_file(path), name: value}, path)
    with pytest.raises(DataError, match=message):
        read_scene(tmp_path)


def test_a_pose_that_is_none_is_refused(tmp_path: Path) -> None:
    scene = satellites()
    bad = dataclasses.replace(scene.frames[0], cam_from_world=RigidTransform(np.eye(3) * 2, np.zeros(3)))
    with pytest.raises(DataError, match=r"pose of frame 'a\.tif' is no rigid motion"):
        write_scene(scene.replace(frames=(bad, *scene.frames[1:])), tmp_path)
