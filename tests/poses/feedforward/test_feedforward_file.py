"""``predictions.npz`` is read as it is documented, and nothing that lies gets through."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from toolkit.errors import DataError
from toolkit.geometry.cameras import ColmapCamera
from toolkit.geometry.rigid import RigidTransform
from toolkit.poses.feedforward.prediction import Prediction
from toolkit.poses.feedforward.predictions_file import read_predictions, write_predictions


def arrays(**changes: Any) -> dict[str, Any]:
    """Return what a Colab cell writes: two pictures of 64 x 48, scaled to maps of 32 x 24."""
    intrinsics = np.array([[30, 0, 16], [0, 31, 12], [0, 0, 1.0]], dtype=np.float32)
    poses = [RigidTransform.look_at([i, 0.2, -3], [0, 0, 0], (0, 1, 0)).matrix[:3] for i in range(2)]
    made: dict[str, Any] = {
        "names": np.array(["a.png", "b.png"]),
        "sizes": np.array([[64, 48], [64, 48]]),
        "intrinsics": np.stack([intrinsics, intrinsics]),
        "cam_from_world": np.array(poses, dtype=np.float32),
        "depth": np.random.default_rng(0).uniform(2, 3, (2, 24, 32)).astype(np.float32),
        "confidence": np.ones((2, 24, 32), dtype=np.float32),
    }
    made.update(changes)
    return {name: value for name, value in made.items() if value is not None}


def write(path: Path, **changes: Any) -> Path:
    np.savez_compressed(path, **arrays(**changes))
    return path


def test_what_a_cell_writes_is_read(tmp_path: Path) -> None:
    made = read_predictions(write(tmp_path / "p.npz", depth=arrays()["depth"][..., None]))
    assert made.names == ("a.png", "b.png")
    # Twice the size: everything in pixels doubles.
    assert made.cameras[0] == ColmapCamera("PINHOLE", 64, 48, (60, 62, 32, 24))
    np.testing.assert_allclose(made.picture_from_map, [[2, 2, 0, 0]] * 2)
    pixels = made.cameras[0].project(made.cam_from_world[0].apply(made.points[0, 3, 5].astype(float)[None]))
    np.testing.assert_allclose(pixels, [[11, 7]], atol=1e-3)


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    colours = np.random.default_rng(1).integers(0, 256, (2, 24, 32, 3)).astype(np.uint8)
    first = read_predictions(
        write(tmp_path / "p.npz", picture_from_map=np.array([[2, 2, 0, 1.0], [1.5, 1.5, -2, 0]]), colours=colours)
    )
    write_predictions(tmp_path / "q.npz", first)
    again = read_predictions(tmp_path / "q.npz")
    assert again.names == first.names
    assert again.provider == first.provider
    for one, other in zip(first.cameras, again.cameras, strict=True):
        np.testing.assert_allclose(one.params, other.params, rtol=1e-12)
    for name in ("depth", "confidence", "points", "picture_from_map", "colours"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    for one, other in zip(first.cam_from_world, again.cam_from_world, strict=True):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=1e-12)


def test_a_rotation_of_single_precision_becomes_one(tmp_path: Path) -> None:
    made = read_predictions(write(tmp_path / "p.npz"))
    rotation = made.cam_from_world[1].rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def poses(matrix: Any) -> Any:
    return np.repeat(np.asarray(matrix, dtype=np.float32)[None], 2, axis=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"depth": None, "names": None}, "lacks arrays of a prediction; .*found no names, no depth"),
        ({"names": np.array([1, 2])}, "'names' is no list of names"),
        ({"depth": np.ones((3, 24, 32))}, r"'depth' does not fit the names; expected \(2, H, W\)"),
        ({"depth": np.array([["x"]])}, "'depth' holds no numbers"),
        ({"confidence": np.ones((2, 32, 24))}, "'confidence' has another shape"),
        ({"sizes": np.array([[64.0, 48.0]] * 2)}, "'sizes' holds no sizes"),
        ({"sizes": np.array([[0, 48]] * 2)}, "'sizes' holds no sizes"),
        ({"sizes": np.array([64, 48])}, r"'sizes' has another shape; expected \(2, 2\)"),
        ({"intrinsics": np.ones((2, 3, 3))}, "no calibration matrix"),
        ({"intrinsics": np.full((2, 3, 3), np.nan)}, "no calibration matrix"),
        ({"cam_from_world": np.ones((2, 3, 3))}, "'cam_from_world' does not fit the names"),
        ({"cam_from_world": poses(np.ones((3, 4)))}, "A pose has no rotation"),
        ({"cam_from_world": poses(np.diag([1, 1, -1, 1.0]))}, "A pose has no rotation"),
        ({"cam_from_world": poses(np.full((3, 4), np.inf))}, "A pose is not finite"),
        ({"depth": np.full((2, 24, 32), np.nan)}, "no sound depth or points for 'a.png'"),
        ({"depth": np.full((2, 24, 32), 1e300)}, "no sound depth or points for 'a.png'"),
        ({"points": np.ones((2, 24, 32))}, "'points' of the prediction does not fit"),
        ({"picture_from_map": np.ones(4)}, "'picture_from_map' has another shape"),
        ({"names": np.array(["a.png", "a.png"])}, "same name"),
        ({"names": np.array(["a.png", "b.png"], dtype=object)}, "of a kind that is not read"),
        ({"names": np.array(["a.png", "b" * 2000])}, "of a kind that is not read"),
        ({"depth": np.ones((2, 24, 32), dtype=np.complex64)}, "of a kind that is not read"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_predictions(write(tmp_path / "p.npz", **changes))


def test_poses_of_the_other_direction_are_refused(tmp_path: Path) -> None:
    sound = read_predictions(write(tmp_path / "p.npz"))
    inverse = np.array([pose.inverse().matrix[:3] for pose in sound.cam_from_world])
    write(tmp_path / "q.npz", points=sound.points, cam_from_world=inverse)
    with pytest.raises(DataError, match="contradict each other.*Check that poses are cam_from_world"):
        read_predictions(tmp_path / "q.npz")


def member(name: str, header: bytes, body: bytes = b"") -> tuple[str, bytes]:
    return f"{name}.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + body


def rewritten(path: Path, name: str, content: bytes) -> Path:
    """Replace one member of the archive."""
    made = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(made, "w") as new:
        for info in old.infolist():
            new.writestr(info.filename, content if info.filename == name else old.read(info))
    path.write_bytes(made.getvalue())
    return path


@pytest.mark.parametrize("shape", ["(2, 1000000, 1000000)", "(2, 24, 33)", "(2, -1, 32)"])
def test_a_header_that_promises_more_than_there_is_is_refused(tmp_path: Path, shape: str) -> None:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}}}\n".encode()
    name, content = member("depth", header, b"\0" * (2 * 24 * 32 * 4))
    path = rewritten(write(tmp_path / "p.npz"), name, content)
    with pytest.raises(DataError, match="header of the array 'depth'.*lies|Cannot read"):
        read_predictions(path)


def test_a_header_of_another_version_is_refused(tmp_path: Path) -> None:
    path = rewritten(write(tmp_path / "p.npz"), "depth.npy", b"\x93NUMPY\x07\x00" + b"\0" * 200)
    with pytest.raises(DataError, match="'depth'.*unknown version"):
        read_predictions(path)


def test_more_than_a_machine_holds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("toolkit.poses.feedforward.predictions_file._MOST_BYTES", 1000)
    with pytest.raises(DataError, match="too large"):
        read_predictions(write(tmp_path / "p.npz"))


def test_a_damaged_file_is_told(tmp_path: Path) -> None:
    whole = write(tmp_path / "p.npz").read_bytes()
    for cut in (0, 10, len(whole) // 2, len(whole) - 30):
        (tmp_path / "cut.npz").write_bytes(whole[:cut])
        with pytest.raises(DataError, match=r"Cannot read .*cut\.npz; expected an \.npz file"):
            read_predictions(tmp_path / "cut.npz")
    spoilt = bytearray(whole)
    with zipfile.ZipFile(io.BytesIO(whole)) as archive:
        info = archive.getinfo("depth.npy")
        spoilt[info.header_offset + 100 + info.compress_size // 2] ^= 0xFF
    (tmp_path / "spoilt.npz").write_bytes(bytes(spoilt))
    with pytest.raises(DataError, match=r"Cannot read .*spoilt\.npz"):
        read_predictions(tmp_path / "spoilt.npz")
    with pytest.raises(DataError, match=r"There is no file .*none\.npz"):
        read_predictions(tmp_path / "none.npz")


def test_nothing_in_a_file_is_run(tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "boom",))

    path = tmp_path / "p.npz"
    np.savez(path, allow_pickle=True, **arrays(provider=np.array(Bomb(), dtype=object)))
    with pytest.raises(DataError, match="of a kind that is not read"):
        read_predictions(path)
    assert not (tmp_path / "boom").exists()


def test_a_disk_that_refuses_is_told_and_leaves_nothing(tmp_path: Path) -> None:
    made: Prediction = read_predictions(write(tmp_path / "p.npz"))
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(Exception, match="in the way"):
        write_predictions(tmp_path / "file" / "q.npz", made)
