"""Damaged COLMAP models: an error that says what is wrong, or the right model; never a crash, never half a model.

pycolmap's own reader loops for ever on some of these files, asks for all memory on others, and reads some cut off
ones as whole.
"""

from __future__ import annotations

import random
import re
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import pytest
from random_scenes import assert_same_points, assert_same_poses, small_scene

from toolkit.errors import DataError
from toolkit.scene import Scene
from toolkit.scene.colmap import read_colmap, write_colmap

PICTURES = Path("/pictures")
XYZ = small_scene().points.xyz
KINDS = ("cameras", "images", "points3D")


@pytest.fixture(params=["bin", "txt"])
def model(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[Path, str]:
    """A small model and the ending of its files."""
    write_colmap(small_scene(), tmp_path, binary=request.param == "bin")
    return tmp_path, request.param


def same(one: Scene, other: Scene) -> bool:
    try:
        assert_same_poses(one, other)
        assert_same_points(one.points, other.points)
    except AssertionError:
        return False
    return dict(one.cameras) == dict(other.cameras) and [f.name for f in one.frames] == [
        f.name for f in other.frames
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_cut_off_at_any_byte_is_an_error(model: tuple[Path, str], kind: str) -> None:
    folder, ending = model
    path = folder / f"{kind}.{ending}"
    whole, right = path.read_bytes(), read_colmap(folder, PICTURES)
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        try:
            found = read_colmap(folder, PICTURES)
        except DataError:
            continue
        # Text has no count: without its last line, cameras.txt is a whole file with fewer cameras.
        assert ending == "txt", f"{kind} cut off at byte {length} of {len(whole)} was read as whole"
        assert same(found, right), f"{kind} cut off at byte {length} was read as another model"


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bytes_are_an_error_or_a_model_that_agrees_with_itself(model: tuple[Path, str], kind: str) -> None:
    folder, ending = model
    path = folder / f"{kind}.{ending}"
    whole = path.read_bytes()
    rng = random.Random(f"{kind}{ending}")
    letters = b"0123456789 -.e#\n\r\x00\xffnaif"
    for _ in range(150):
        damaged = bytearray(whole)
        for _ in range(rng.choice([1, 1, 2, 8])):
            at = rng.randrange(len(damaged))
            damaged[at] = rng.choice(letters) if ending == "txt" else rng.choice([0, 255, rng.randrange(256)])
        if rng.random() < 0.2:
            at = rng.randrange(len(damaged))
            damaged[at:at] = bytes(rng.randrange(256) for _ in range(rng.randrange(20)))
        path.write_bytes(damaged)
        try:
            scene = read_colmap(folder, PICTURES)
        except DataError:
            continue
        scene.to_pycolmap()


@pytest.mark.parametrize(
    ("kind", "what"),
    [("cameras", "24 bytes"), ("images", "73 bytes"), ("points3D", "51 bytes")],
)
@pytest.mark.parametrize("count", [100, 2**32, 2**63, 2**64 - 1])
def test_a_lying_count_is_found_before_anything_is_allocated(
    tmp_path: Path, kind: str, what: str, count: int
) -> None:
    write_colmap(small_scene(), tmp_path)
    path = tmp_path / f"{kind}.bin"
    path.write_bytes(struct.pack("<Q", count) + b"\0" * 100)
    with pytest.raises(DataError, match=rf"{kind}\.bin is cut off or damaged; expected {count} records of {what}"):
        read_colmap(tmp_path, PICTURES)


def change_bytes(kind: str, old: bytes, new: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / f"{kind}.bin"
        data = path.read_bytes()
        assert old in data
        path.write_bytes(data.replace(old, new, 1))

    return change


def append(kind: str, more: bytes) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        with (folder / f"{kind}.bin").open("ab") as handle:
            handle.write(more)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (append("points3D", b"\0"), r"points3D\.bin is longer than it says"),
        (append("images", b"\0"), r"images\.bin is longer than it says"),
        (append("cameras", b"\0"), r"cameras\.bin is longer than it says"),
        (
            change_bytes("cameras", struct.pack("<Ii", 1, 1), struct.pack("<Ii", 1, 99)),
            r"unknown model; found number 99",
        ),
        (
            change_bytes("cameras", struct.pack("<Ii", 1, 1), struct.pack("<Ii", 2, 1)),
            r"cameras\.bin has number 2 twice",
        ),
        (
            change_bytes("cameras", struct.pack("<QQ", 64, 48), struct.pack("<QQ", 2**60, 48)),
            r"camera in .*cameras\.bin, number 1 has an impossible size",
        ),
        (
            change_bytes("cameras", struct.pack("<d", 51.5), struct.pack("<d", float("nan"))),
            r"camera in .*number 1 is damaged.*not finite",
        ),
        (
            change_bytes("images", b"a.jpg\0", b"\xff.jpg\0"),
            r"A name in .*images\.bin is not UTF-8",
        ),
        (
            change_bytes("images", b"a.jpg\0", b"../ab\0"),
            r"model in .* is no scene.*'\.\./ab' leaves the image folder",
        ),
        (change_bytes("images", b"a.jpg\0", b"/a.jp\0"), r"'/a\.jp' leaves the image folder"),
        (change_bytes("images", b"a.jpg\0", b"a.j\ng\0"), r"name 'a\.j\\ng' cannot be stored"),
        (change_bytes("images", b"a.jpg\0", b"c.jpg\0"), r"Two frames have the same name"),
        (
            change_bytes("images", struct.pack("<I", 1) + b"a.jpg", struct.pack("<I", 7) + b"a.jpg"),
            r"Image 'a\.jpg' in .* has no camera; expected one of \[1, 2\]; found 7",
        ),
        (
            change_bytes("images", struct.pack("<d", 1.5), struct.pack("<d", float("inf"))),
            r"keypoints that are not finite",
        ),
        (
            change_bytes("images", struct.pack("<ddQ", 1.5, 2.5, 1), struct.pack("<ddQ", 1.5, 2.5, 3)),
            r"Images and points in .* contradict each other",
        ),
        (
            change_bytes("images", struct.pack("<ddQ", 1.5, 2.5, 1), struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1)),
            r"contradict each other.*found 3 keypoints with a point and 4 track elements",
        ),
        (
            change_bytes("points3D", struct.pack("<QII", 2, 1, 0), struct.pack("<QII", 2, 6, 0)),
            r"points in .* do not belong to its images.*found image 6",
        ),
        (
            change_bytes("points3D", struct.pack("<QII", 2, 1, 0), struct.pack("<QII", 2, 1, 5)),
            r"points in .* do not belong to its images.*image 1, keypoints 1 to 5",
        ),
        (
            change_bytes("points3D", struct.pack("<Qd", 2, XYZ[1, 0]), struct.pack("<Qd", 1, XYZ[1, 0])),
            r"two points of one number",
        ),
        (
            change_bytes("points3D", struct.pack("<d", -1.0), struct.pack("<d", float("nan"))),
            r"points that are not finite",
        ),
    ],
)
def test_each_contradiction_is_named(tmp_path: Path, change: Callable[[Path], None], message: str) -> None:
    write_colmap(small_scene(), tmp_path)
    change(tmp_path)
    with pytest.raises(DataError, match=message):
        read_colmap(tmp_path, PICTURES)


@pytest.mark.parametrize(
    "pose", [(0.0, 0, 0, 0, 1, 2, 3), (1.0, 0, 0, 0, float("nan"), 2, 3), (1e9, 0, 0, 0, 0, 0, 0)]
)
def test_a_pose_without_rotation_is_named(tmp_path: Path, pose: tuple[float, ...]) -> None:
    write_colmap(small_scene(), tmp_path)
    path = tmp_path / "images.bin"
    data = path.read_bytes()
    path.write_bytes(data[:12] + struct.pack("<7d", *pose) + data[12 + 56 :])
    with pytest.raises(DataError, match=r"pose in .*images\.bin, image 1 is damaged; expected a unit quaternion"):
        read_colmap(tmp_path, PICTURES)


@pytest.mark.parametrize(
    ("kind", "old", "new", "message"),
    [
        ("cameras", "1 PINHOLE", "1 PINHOLES", r"line 4 is damaged.*Unknown camera model 'PINHOLES'"),
        ("cameras", "1 PINHOLE 64", "1 PINHOLE -64", r"line 4; expected numbers of 0 to"),
        ("cameras", "1 PINHOLE 64", "1 PINHOLE 6.4", r"line 4; expected whole numbers"),
        ("cameras", "50 51.5 32 24", "50 51.5 32", r"Wrong number of parameters"),
        ("cameras", " 64 48 50 51.5 32 24", "", r"line 4 is cut off; expected at least 5 words; found 2"),
        ("cameras", "51.5", "fifty", r"line 4; expected numbers; found could not convert"),
        ("images", " 1 a.jpg", "", r"line 5 is cut off; expected at least 10 words"),
        ("images", "1.5 2.5", "1.5", r"line 6 is cut off; expected three words a keypoint"),
        ("images", "1.5 2.5 1", "1.5 nan 1", r"keypoints that are not finite"),
        ("points3D", " 3 1 1 1\n", " 3 1 1\n", r"is cut off; expected two words a track element"),
        ("points3D", "7 8 255", "7 8 256", r"expected numbers of 0 to 255"),
    ],
)
def test_damaged_text_is_named_with_its_line(tmp_path: Path, kind: str, old: str, new: str, message: str) -> None:
    write_colmap(small_scene(), tmp_path, binary=False)
    path = tmp_path / f"{kind}.txt"
    text = path.read_text()
    assert old in text, text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        read_colmap(tmp_path, PICTURES)


def test_text_without_its_last_line_break_is_taken_for_cut_off(tmp_path: Path) -> None:
    write_colmap(small_scene(), tmp_path, binary=False)
    path = tmp_path / "cameras.txt"
    path.write_text(path.read_text()[:-1])
    with pytest.raises(
        DataError, match=r"cameras\.txt is cut off; expected a line break at its end.*add the line break"
    ):
        read_colmap(tmp_path, PICTURES)


def test_text_with_other_line_ends_comments_and_empty_lines_is_read(tmp_path: Path) -> None:
    write_colmap(small_scene(), tmp_path, binary=False)
    right = read_colmap(tmp_path, PICTURES)
    for kind in ("cameras", "points3D"):
        path = tmp_path / f"{kind}.txt"
        path.write_bytes(b"# hello\n\n" + path.read_bytes().replace(b"\n", b"\r\n") + b"\r\n")
    images = tmp_path / "images.txt"
    images.write_bytes(images.read_bytes().replace(b"\n", b"\r\n"))
    assert same(read_colmap(tmp_path, PICTURES), right)


def test_text_that_is_no_text_and_folders_in_place_of_files_are_errors(tmp_path: Path) -> None:
    write_colmap(small_scene(), tmp_path, binary=False)
    (tmp_path / "cameras.txt").write_bytes(b"\xff\xfe1 PINHOLE\n")
    with pytest.raises(DataError, match=r"cameras\.txt is not UTF-8 text"):
        read_colmap(tmp_path, PICTURES)
    (tmp_path / "cameras.txt").unlink()
    (tmp_path / "cameras.txt").mkdir()
    with pytest.raises(DataError, match="No COLMAP model"):
        read_colmap(tmp_path, PICTURES)


def test_a_file_that_may_not_be_read_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_colmap(small_scene(), tmp_path)

    def refuse(self: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(DataError, match=r"Cannot read the COLMAP model in .*Permission denied"):
        read_colmap(tmp_path, PICTURES)


def test_binary_files_are_preferred_as_colmap_does(tmp_path: Path) -> None:
    write_colmap(small_scene(), tmp_path / "text", binary=False)
    write_colmap(small_scene(), tmp_path)
    for path in (tmp_path / "text").iterdir():
        shutil.copy(path, tmp_path / path.name)
    (tmp_path / "cameras.txt").write_text("nonsense\n")
    assert len(read_colmap(tmp_path, PICTURES)) == 2


def test_the_error_names_the_file(tmp_path: Path) -> None:
    write_colmap(small_scene(), tmp_path)
    path = tmp_path / "images.bin"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(DataError, match=re.escape(str(path)) + r".*Copy or export the model again\.$"):
        read_colmap(tmp_path, PICTURES)
