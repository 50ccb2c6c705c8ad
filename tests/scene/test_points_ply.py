"""Point clouds as PLY files."""

from __future__ import annotations

import random
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from toolkit.errors import DataError
from toolkit.scene import Points
from toolkit.scene.ply import read_points, write_points

XYZ = np.array([[0.1, -2.0, 1e-30], [1e7 + 1 / 3, 5.0, -0.0], [1.0, 2.0, 3.0]])
RGB = np.array([[0, 1, 2], [255, 254, 253], [9, 8, 7]], np.uint8)


def table(*extra: tuple[str, str]) -> np.ndarray:
    layout = [("x", "f8"), ("y", "f8"), ("z", "f8"), *extra, ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    made = np.zeros(len(XYZ), layout)
    for column, name in enumerate("xyz"):
        made[name] = XYZ[:, column]
    for column, name in enumerate(("red", "green", "blue")):
        made[name] = RGB[:, column]
    return made


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 50), st.integers(0, 2**32 - 1))
def test_points_survive_to_the_bit(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = Points(
        rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-300, 300, (count, 1)),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
    )
    with tempfile.TemporaryDirectory() as folder:
        write_points(points, Path(folder) / "a.ply")
        again = read_points(Path(folder) / "a.ply")
    np.testing.assert_array_equal(again.xyz, points.xyz)
    np.testing.assert_array_equal(again.rgb, points.rgb)
    assert (again.xyz.dtype, again.rgb.dtype) == (np.float64, np.uint8)


@pytest.mark.parametrize("text", [True, False])
@pytest.mark.parametrize("order", ["<", ">"])
def test_another_writers_files_are_read(tmp_path: Path, text: bool, order: str) -> None:
    extra = (("nx", "f4"), ("quality", "i2"), ("flags", "u4"))
    vertex = PlyElement.describe(table(*extra), "vertex", comments=["a vertex"])
    faces = np.array([([0, 1, 2], 7)], dtype=[("vertex_indices", "i4", (3,)), ("flag", "u1")])
    for number, elements in enumerate([[vertex], [vertex, PlyElement.describe(faces, "face")]]):
        path = tmp_path / f"{number}.ply"
        PlyData(elements, text=text, byte_order=order, comments=["made ßomewhere"[:4]], obj_info=["x"]).write(
            str(path)
        )
        points = read_points(path)
        np.testing.assert_array_equal(points.xyz, XYZ)
        np.testing.assert_array_equal(points.rgb, RGB)


@pytest.mark.parametrize("text", [True, False])
def test_elements_before_the_vertices_are_stepped_over(tmp_path: Path, text: bool) -> None:
    camera = PlyElement.describe(np.zeros(2, [("f", "f8"), ("n", "i2")]), "camera")
    PlyData([camera, PlyElement.describe(table(), "vertex")], text=text).write(str(tmp_path / "a.ply"))
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply").xyz, XYZ)


def test_another_reader_reads_ours(tmp_path: Path) -> None:
    write_points(Points(XYZ, RGB), tmp_path / "a.ply")
    data = PlyData.read(str(tmp_path / "a.ply"))
    assert (data.text, data.byte_order) == (False, "<")
    np.testing.assert_array_equal(data["vertex"]["y"], XYZ[:, 1])
    np.testing.assert_array_equal(data["vertex"]["blue"], RGB[:, 2])


def ply(header: str, body: bytes, end: str = "\n") -> bytes:
    return ("ply\n" + header.strip() + "\nend_header\n").replace("\n", end).encode() + body


LITTLE = """
format binary_little_endian 1.0
element vertex 2
property float x
property float y
property float z
"""
ASCII = LITTLE.replace("binary_little_endian", "ascii")
BODY = np.arange(6, dtype="<f4").tobytes()


def read(tmp_path: Path, content: bytes) -> Points:
    (tmp_path / "a.ply").write_bytes(content)
    return read_points(tmp_path / "a.ply")


def test_points_without_colours_are_grey(tmp_path: Path) -> None:
    assert (read(tmp_path, ply(LITTLE, BODY)).rgb == 128).all()


def test_windows_line_ends_and_empty_lines_are_read(tmp_path: Path) -> None:
    points = read(tmp_path, ply(ASCII, b"0 1 2\r\n\r\n3 4 5\r\n", "\r\n"))
    np.testing.assert_array_equal(points.xyz, np.arange(6.0).reshape(2, 3))


def test_float_colours_are_of_zero_to_one(tmp_path: Path) -> None:
    header = LITTLE.replace("vertex 2", "vertex 1")
    header += "\n".join(f"property float {name}" for name in ("red", "green", "blue"))
    assert read(tmp_path, ply(header, np.array([0, 0, 0, 0, 0.5, 1], "<f4").tobytes())).rgb.tolist() == [
        [0, 128, 255]
    ]
    with pytest.raises(DataError, match=r"colours out of range; expected 0 to 1\.0; found type float32"):
        read(tmp_path, ply(header, np.array([0, 0, 0, 0, 0.5, 200], "<f4").tobytes()))
    with pytest.raises(DataError, match=r"colours out of range"):
        read(tmp_path, ply(header, np.array([0, 0, 0, 0, 0.5, np.nan], "<f4").tobytes()))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"a\.ply is no PLY file; expected 'ply' in its first line; found b''"),
        (b"PK\x03\x04", r"a\.ply is no PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 2\n", r"a\.ply is cut off or lies; expected 'end_header'"),
        (b"ply\n" + b"comment x\n" * 10_000, r"in the first 65536 bytes; found a header without end"),
        (ply(LITTLE, BODY[:-1]), r"expected 2 vertices of 12 bytes; found 23 bytes .*export it again"),
        (ply(LITTLE, BODY + b"\n"), r"longer than its header says; .*found 1 bytes after the last vertex"),
        (ply(LITTLE.replace("vertex 2", "vertex 90000000000000000"), BODY), r"expected 90000000000000000 vertices"),
        (ply(LITTLE.replace("vertex 2", "vertex 9" + "0" * 30), BODY), r"no PLY header; found 'element vertex 90"),
        (ply(LITTLE.replace("vertex 2", "vertex -2"), BODY), r"no PLY header; found 'element vertex -2'"),
        (ply(LITTLE.replace("vertex 2", "vertex two"), BODY), r"no PLY header; found 'element vertex two'"),
        (ply(LITTLE.replace("format", "formal"), BODY), r"no PLY header; found 'formal binary"),
        (ply(LITTLE.replace("binary_little_endian", "zip"), BODY), r"no PLY header; found 'format zip 1\.0'"),
        (ply(LITTLE.replace("format binary_little_endian 1.0", ""), BODY), r"has no format; expected one of ascii"),
        (ply(LITTLE.replace("element vertex", "element point"), BODY), r"has no vertices; .*found point"),
        (ply("format ascii 1.0", b""), r"has no vertices; expected one element 'vertex'; found no element"),
        (ply(LITTLE + "element vertex 0", BODY), r"has vertices twice; expected one element 'vertex'"),
        (ply(LITTLE.replace("float y", "float x"), BODY), r"repeated property in element 'vertex'.*'float x'"),
        (ply(LITTLE.replace("float y", "quad y"), BODY), r"unknown or repeated property.*found 'quad y'"),
        (ply(LITTLE.replace("float y", "float"), BODY), r"unknown or repeated property.*found 'float'"),
        (
            ply(LITTLE + "property list uchar int bones", BODY),
            r"list properties in .*'vertex'; .*plain point cloud",
        ),
        (
            ply(LITTLE.replace("element", "element face 1\nproperty list uchar int i\nelement", 1), BODY),
            r"list properties in element 'face'",
        ),
        (ply("format ascii 1.0\nelement vertex 0", b""), r"element 'vertex' without properties"),
        (ply("format ascii 1.0\nproperty float x", b""), r"no PLY header; found 'property float x'"),
        (ply(LITTLE.replace("float z", "float depth"), BODY), r"no coordinates z; .*found x, y, depth"),
        (ply(LITTLE + "property uchar red", BODY + b"  "), r"half a colour; .*found red"),
        (
            ply(LITTLE, np.array([0, 1, 2, 3, np.nan, 5], "<f4").tobytes()),
            r"points that are not finite; .*found 1 of 2, the first in row 1: \[3\.0, nan, 5\.0\]",
        ),
        (ply(ASCII, b"0 1 2\n3 4\n"), r"expected 3 numbers in each line; found 2 for vertex 1"),
        (ply(ASCII, b"0 1 2\n3 4 5 6\n"), r"expected 3 numbers in each line; found 4 for vertex 1"),
        (ply(ASCII, b"0 1 2\n3 4 5"), r"expected a line break after the last line; found b'0 1 2"),
        (ply(ASCII, b"0 1 2\n"), r"expected 2 lines of vertices; found 1"),
        (ply(ASCII, b"0 1 2\n3 4 5\n6 7 8\n"), r"longer than its header says; .*found 1 lines"),
        (ply(ASCII, b"0 1 2\n3 x 5\n"), r"vertices that are no numbers; found could not convert"),
        (ply(ASCII, b"0 1 2\n3 inf 5\n"), r"points that are not finite"),
        (ply(ASCII, b"0 1 2\n3 1e39 5\n"), r"points that are not finite"),
        (
            ply(ASCII.replace("vertex 2", "vertex 90000000000000000"), b"0 1 2\n"),
            r"expected 90000000000000000 lines",
        ),
        (
            ply(ASCII + "property uchar blue", b"0 1 2 255\n0 1 2 256\n"),
            r"numbers that do not fit; expected 'blue' of 0 to 255",
        ),
    ],
)
def test_each_fault_is_named(tmp_path: Path, content: bytes, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read(tmp_path, content)


@pytest.mark.parametrize("text", [True, False])
def test_a_file_cut_off_at_any_byte_is_an_error(tmp_path: Path, text: bool) -> None:
    path = tmp_path / "a.ply"
    PlyData([PlyElement.describe(table(), "vertex")], text=text).write(str(path))
    whole = path.read_bytes()
    for length in range(len(whole)):
        path.write_bytes(whole[:length])
        try:
            points = read_points(path)
        except DataError:
            continue
        pytest.fail(f"cut off at byte {length} of {len(whole)} it was read as {len(points)} points")


def test_damaged_bytes_are_an_error_or_points(tmp_path: Path) -> None:
    path, rng = tmp_path / "a.ply", random.Random(1)
    for text in (True, False):
        PlyData([PlyElement.describe(table(), "vertex")], text=text).write(str(path))
        whole = path.read_bytes()
        for _ in range(400):
            damaged = bytearray(whole)
            for _ in range(rng.choice([1, 2, 8])):
                damaged[rng.randrange(len(damaged))] = rng.choice(b"0129 \n-.eflu\x00\xff")
            path.write_bytes(damaged)
            try:
                points = read_points(path)
            except DataError:
                continue
            assert np.isfinite(points.xyz).all()


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone\.ply is missing; expected a PLY file"):
        read_points(tmp_path / "gone.ply")
    with pytest.raises(DataError, match=r"Cannot read .*; expected a PLY file; found .*Is a directory"):
        read_points(tmp_path)


def test_writing_is_one_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.ply"
    write_points(Points(XYZ, RGB), path)
    before = path.read_bytes()

    def half(self: PlyData, stream: str) -> None:
        Path(stream).write_bytes(before[:100])
        raise KeyboardInterrupt

    monkeypatch.setattr(PlyData, "write", half)
    with pytest.raises(KeyboardInterrupt):
        write_points(Points(XYZ[:1], RGB[:1]), path)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["a.ply"]
