"""Meshes and clouds come back from files as they were; damaged files are told, never guessed at."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from shapes import ball

from toolkit.errors import DataError
from toolkit.geometry.surface import Cloud, Mesh
from toolkit.scene.mesh_files import SUFFIXES, read_cloud, read_mesh, write_cloud, write_mesh
from toolkit.scene.ply import read_points

FAR = (500_000.0, 5_300_000.0, 100.0)

SQUARE = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n"
)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_comes_back(tmp_path: Path, suffix: str) -> None:
    mesh = ball(2.0, FAR, finer=3)
    path = tmp_path / f"a{suffix}"
    write_mesh(path, mesh)
    back = read_mesh(path)
    # PLY is double; OBJ has 12 digits, which is 5 um at these coordinates; GLB single precision about the middle.
    np.testing.assert_allclose(
        back.vertices, mesh.vertices, rtol=0, atol={".ply": 0, ".obj": 6e-6, ".glb": 3e-7}[suffix]
    )
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.rgb, mesh.rgb)
    assert [item.name for item in tmp_path.iterdir()] == [path.name]
    plain = Mesh(mesh.vertices, mesh.faces)
    write_mesh(path, plain)
    assert read_mesh(path).rgb is None


def test_ply_keeps_normals_in_single_precision_and_serves_as_points(tmp_path: Path) -> None:
    mesh = ball(finer=2)
    write_mesh(tmp_path / "a.ply", mesh)
    back = read_mesh(tmp_path / "a.ply")
    assert back.normals is not None
    np.testing.assert_allclose(back.normals, mesh.normals, atol=1e-7)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply").xyz, mesh.vertices)


def test_a_cloud_comes_back_with_what_it_has(tmp_path: Path) -> None:
    mesh = ball(finer=2)
    path = tmp_path / "a.ply"
    for rgb in (None, mesh.rgb):
        for normals in (None, mesh.normals):
            write_cloud(path, Cloud(mesh.vertices, rgb, normals))
            back = read_cloud(path)
            np.testing.assert_array_equal(back.xyz, mesh.vertices)
            assert (back.rgb is None) == (rgb is None)
            assert (back.normals is None) == (normals is None)
    np.testing.assert_array_equal(back.rgb, mesh.rgb)
    np.testing.assert_allclose(back.normals, mesh.normals, atol=1e-7)


def test_open3d_reads_the_same(tmp_path: Path) -> None:
    import open3d as o3d

    mesh = ball(finer=2)
    assert mesh.rgb is not None
    for suffix in (".ply", ".obj"):
        path = tmp_path / f"a{suffix}"
        write_mesh(path, mesh)
        other = o3d.io.read_triangle_mesh(str(path))
        # It numbers the vertices of OBJ anew; corners of faces stay in order. Single precision, colours of 8 bits.
        corners = np.asarray(other.triangles)
        np.testing.assert_allclose(np.asarray(other.vertices)[corners], mesh.vertices[mesh.faces], atol=1e-6)
        np.testing.assert_allclose(np.asarray(other.vertex_colors)[corners], mesh.rgb[mesh.faces] / 255, atol=1e-3)


def test_polygons_become_fans(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(SQUARE + b"4 0 1 2 3\n")
    np.testing.assert_array_equal(read_mesh(path).faces, [[0, 1, 2], [0, 2, 3]])
    # Binary, of other lengths in each row, with a flag behind each list.
    head = SQUARE[: SQUARE.index(b"0 0 0")].replace(b"ascii", b"binary_big_endian").replace(b"face 1", b"face 2")
    head = head.replace(b"vertex_indices\n", b"vertex_indices\nproperty uchar flags\n")
    body = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], ">f4").tobytes()
    rows = struct.pack(">B4iB", 4, 0, 1, 2, 3, 7) + struct.pack(">B3iB", 3, 0, 1, 3, 7)
    path.write_bytes(head + body + rows)
    np.testing.assert_array_equal(read_mesh(path).faces, [[0, 1, 2], [0, 2, 3], [0, 1, 3]])
    path = tmp_path / "a.obj"
    path.write_text(
        "# made elsewhere\nv 0 0 0\nv 1 0 0\nv 1 1 0 1.0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1 -1/1\n"
    )
    np.testing.assert_array_equal(read_mesh(path).faces, [[0, 1, 2], [0, 2, 3]])


BAD = {
    "nothing.ply": (b"", "is no PLY file"),
    "cloud.ply": (SQUARE.replace(b"face 1", b"face 0"), "has no faces; expected a mesh; found a cloud of points"),
    "lies.ply": (SQUARE.replace(b"face 1", b"face 900000000") + b"4 0 1 2 3\n", "cut off or lies"),
    "range.ply": (
        SQUARE + b"3 0 1 4\n",
        r"name vertices that it has not; expected numbers from 0 to 3; found 0 to 4",
    ),
    "negative.ply": (SQUARE + b"3 0 1 -1\n", "name vertices that it has not"),
    "two.ply": (SQUARE + b"2 0 1\n", "face of 2 corners"),
    "short.ply": (SQUARE + b"4 0 1 2\n", "has a face 0 that is none"),
    "long.ply": (SQUARE + b"3 0 1 2\n3 0 1 2\n", "longer than its header says"),
    "words.ply": (SQUARE + b"3 a b c\n", "has a face 0 that is none"),
    "open.ply": (SQUARE + b"3 0 1 2", "cut off or lies; expected a line break"),
    "nan.ply": (SQUARE.replace(b"1 1 0\n", b"1 nan 0\n") + b"3 0 1 2\n", "not finite"),
    "corners.ply": (SQUARE.replace(b"vertex_indices", b"other") + b"3 0 1 2\n", "has faces without corners"),
    "nothing.obj": (b"", "has no faces; expected a mesh; found 0 vertices"),
    "half.obj": (b"v 0 0\n", "line 1 that is not understood"),
    "range.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "name vertices that it has not"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4 that is not understood"),
    "nan.obj": (b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
    "mixed.obj": (b"v 0 0 0 1 1 1\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "with and without colours"),
    "bright.obj": (b"v 0 0 0 9 1 1\nv 1 0 0 1 1 1\nv 0 1 0 1 1 1\nf 1 2 3\n", "colours out of range"),
    "bytes.obj": (b"v \xff\xfe\n", "Cannot read"),
    "nothing.glb": (b"", "is no GLB file"),
    "short.glb": (b"glTF" + struct.pack("<III", 2, 999, 4) + b"JSON{}  ", "cut off or lies; expected 999 bytes"),
    "other.stl": (b"", "Meshes are not kept in files of the kind other.stl"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_are_told(tmp_path: Path, name: str) -> None:
    content, message = BAD[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_mesh(tmp_path / name)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_missing_file_is_told(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(DataError, match=f"none{suffix} is missing"):
        read_mesh(tmp_path / f"none{suffix}")


def test_nothing_is_not_written(tmp_path: Path) -> None:
    bare = Mesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32))
    for suffix in SUFFIXES:
        with pytest.raises(DataError, match="A mesh without faces is not written"):
            write_mesh(tmp_path / f"a{suffix}", bare)
    with pytest.raises(DataError, match="not kept in files of the kind a.stl"):
        write_mesh(tmp_path / "a.stl", ball(finer=1))
    with pytest.raises(DataError, match="An empty cloud is not written"):
        write_cloud(tmp_path / "a.ply", Cloud(np.zeros((0, 3))))
    with pytest.raises(DataError, match="Clouds are not kept in files of the kind a.obj; expected .ply"):
        write_cloud(tmp_path / "a.obj", Cloud(np.zeros((1, 3))))
    assert list(tmp_path.iterdir()) == []


def test_a_glb_that_contradicts_itself_is_told(tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    write_mesh(path, ball(finer=1))
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + length])

    def changed(change: object) -> None:
        assert callable(change)
        other = json.loads(json.dumps(document))
        change(other)
        text = json.dumps(other).encode()
        text += b" " * (-len(text) % 4)
        rest = data[20 + length :]
        path.write_bytes(
            b"glTF" + struct.pack("<III", 2, 20 + len(text) + len(rest), len(text)) + b"JSON" + text + rest
        )

    def grow(other: dict[str, list[dict[str, object]]]) -> None:
        other["accessors"][0]["count"] = 10**9

    def circle(other: dict[str, list[dict[str, object]]]) -> None:
        other["nodes"][0]["children"] = [0]

    def lines(other: dict[str, list[dict[str, list[dict[str, object]]]]]) -> None:
        other["meshes"][0]["primitives"][0]["mode"] = 1

    def packed(other: dict[str, object]) -> None:
        other["extensionsRequired"] = ["KHR_draco_mesh_compression"]

    for change, message in (
        (grow, "an accessor that ends after"),
        (circle, "nodes without end"),
        (lines, "has no faces"),
        (packed, "compressed by KHR_draco"),
    ):
        changed(change)
        with pytest.raises(DataError, match=message):
            read_mesh(path)
    path.write_bytes(data[:-8])
    with pytest.raises(DataError, match="cut off or lies"):
        read_mesh(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cut=st.floats(0, 1), at=st.floats(0, 1), byte=st.integers(0, 255), flip=st.booleans())
def test_damaged_files_raise_nothing_but_our_errors(
    tmp_path: Path, suffix: str, cut: float, at: float, byte: int, flip: bool
) -> None:
    path = tmp_path / f"a{suffix}"
    write_mesh(path, ball(finer=1))
    data = bytearray(path.read_bytes())
    if flip:
        data[min(int(at * len(data)), len(data) - 1)] = byte
    else:
        data = data[: int(cut * len(data))]
    path.write_bytes(data)
    try:
        mesh = read_mesh(path)
    except DataError:
        return
    assert len(mesh.faces)
    assert mesh.faces.max() < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()
