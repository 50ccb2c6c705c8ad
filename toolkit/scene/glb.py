"""Binary glTF 2.0 (Khronos, "glTF 2.0 specification", 2021): one mesh with colours of its vertices.

Colours of vertices are linear in glTF and are converted on the way. Axes stay those of the scene, whatever is up.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.errors import DataError
from toolkit.files import atomic_path
from toolkit.geometry.surface import Mesh
from toolkit.scene.ply_faces import no_faces, triangles_of

Array = NDArray[np.float64]

_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_TYPES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _DEEPEST = 4, 64


def write_glb(path: Path, mesh: Mesh) -> None:
    """Write a mesh in one step: coordinates single precision about the middle of its box, which the node holds.

    Raises
    ------
    RunError
        When the disk is full or the folder may not be written.
    """
    middle = 0.5 * (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0))
    positions = (mesh.vertices - middle).astype("<f4")
    body = bytearray()
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def add(values: NDArray[Any], component: int, kind: str, target: int, **more: Any) -> int:
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes, "target": target})
        body.extend(values.tobytes())
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": component,
                "count": len(values),
                "type": kind,
                **more,
            }
        )
        return len(accessors) - 1

    low, high = positions.min(axis=0).tolist(), positions.max(axis=0).tolist()
    attributes = {"POSITION": add(positions, 5126, "VEC3", 34962, min=low, max=high)}
    if mesh.normals is not None:
        attributes["NORMAL"] = add(mesh.normals.astype("<f4"), 5126, "VEC3", 34962)
    if mesh.rgb is not None:
        # Sixteen bits hold the dark of sRGB, and four channels keep rows at multiples of four bytes.
        linear = np.full((len(mesh.rgb), 4), 65535, dtype="<u2")
        linear[:, :3] = np.rint(65535 * _linear_from_srgb(mesh.rgb / 255.0))
        attributes["COLOR_0"] = add(linear, 5123, "VEC4", 34962, normalized=True)
    indices = add(mesh.faces.reshape(-1).astype("<u4"), 5125, "SCALAR", 34963)
    primitive = {"attributes": attributes, "indices": indices, "mode": _TRIANGLES, "material": 0}
    document = {
        "asset": {"version": "2.0", "generator": "sightline-toolkit"},
        # Pictures gave the colours, with the light of their day in them.
        "extensionsUsed": ["KHR_materials_unlit"],
        "materials": [
            {
                "doubleSided": True,
                "extensions": {"KHR_materials_unlit": {}},
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
            }
        ],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": middle.tolist()}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(body)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode("utf-8")
    text += b" " * (-len(text) % 4)
    body.extend(b"\0" * (-len(body) % 4))
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        handle.write(_MAGIC + struct.pack("<II", 2, 12 + 8 + len(text) + 8 + len(body)))
        handle.write(struct.pack("<I", len(text)) + _JSON + text)
        handle.write(struct.pack("<I", len(body)) + _BIN + body)


def read_glb(path: Path) -> Mesh:
    """Read all triangles of all nodes as one mesh in the scene's coordinates; textures are left out.

    Raises
    ------
    DataError
        Where the file is missing, damaged, cut off or longer than it says, without triangles, or compressed.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise DataError(f"{path} is missing", expected="a GLB file") from error
    except OSError as error:
        raise DataError(f"Cannot read {path}", expected="a GLB file", found=str(error)) from error
    document, body = _chunks(data, path)
    try:
        parts = _nodes(document, body)
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise DataError(
            f"{path} contradicts itself",
            expected="glTF 2.0 with triangles in its own buffer",
            found=f"{type(error).__name__}: {error}",
        ) from error
    if not parts:
        raise no_faces(path, found="no triangles")
    starts = np.cumsum([0, *(len(xyz) for xyz, _, _ in parts)])
    faces = np.concatenate(
        [triangles_of(part[1], len(part[0]), path) + start for part, start in zip(parts, starts, strict=False)]
    )
    colours = [part[2] for part in parts]
    rgb = (
        None if any(colour is None for colour in colours) else np.concatenate([c for c in colours if c is not None])
    )
    return Mesh(np.concatenate([part[0] for part in parts]), faces.astype(np.int32), rgb)


def _chunks(data: bytes, path: Path) -> tuple[dict[str, Any], bytes]:
    if data[:4] != _MAGIC or len(data) < 20:
        raise DataError(f"{path} is no GLB file", expected="'glTF' in its first bytes", found=repr(data[:8]))
    version, length, text_length = struct.unpack_from("<III", data, 4)
    if version != 2 or data[16:20] != _JSON:
        raise DataError(f"{path} is no glTF 2.0", expected="version 2 and a JSON chunk", found=f"version {version}")
    if length != len(data) or 20 + text_length > length:
        raise DataError(
            f"{path} is cut off or lies",
            expected=f"{length} bytes",
            found=f"{len(data)}",
            todo="Copy or export it again",
        )
    try:
        document = json.loads(data[20 : 20 + text_length])
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path} has no JSON in its first chunk", found=str(error)) from error
    if not isinstance(document, dict):
        raise DataError(f"{path} has no glTF object in its first chunk", found=type(document).__name__)
    rest = data[20 + text_length :]
    if len(rest) < 8 or rest[4:8] != _BIN or struct.unpack_from("<I", rest)[0] > len(rest) - 8:
        raise DataError(f"{path} has no whole binary chunk", expected="the mesh's own buffer")
    return document, rest[8 : 8 + struct.unpack_from("<I", rest)[0]]


Part = tuple[Array, NDArray[np.int64], NDArray[np.uint8] | None]


def _nodes(document: dict[str, Any], body: bytes) -> list[Part]:
    """Return vertices, triangles and colours of each primitive; whatever is amiss raises a plain error."""
    unread = {"KHR_draco_mesh_compression", "EXT_meshopt_compression"} & set(document.get("extensionsRequired", []))
    if unread:
        raise ValueError(f"compressed by {', '.join(unread)}")
    parts: list[Part] = []

    def walk(number: int, world_from_parent: Array, depth: int) -> None:
        if depth > _DEEPEST:
            raise ValueError("nodes without end")
        node = document["nodes"][number]
        world_from_node = world_from_parent @ _transform(node)
        if "mesh" in node:
            for primitive in document["meshes"][node["mesh"]]["primitives"]:
                if primitive.get("mode", _TRIANGLES) == _TRIANGLES:
                    parts.append(_primitive(document, body, primitive, world_from_node))
        for child in node.get("children", []):
            walk(child, world_from_node, depth + 1)

    for root in document["scenes"][document.get("scene", 0)].get("nodes", []):
        walk(root, np.eye(4), 0)
    return parts


def _transform(node: dict[str, Any]) -> Array:
    """Return the node's (4, 4) matrix; glTF lists it column after column."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    from scipy.spatial.transform import Rotation

    matrix = np.eye(4)
    rotation = Rotation.from_quat(node.get("rotation", [0.0, 0.0, 0.0, 1.0])).as_matrix()
    matrix[:3, :3] = rotation * np.array(node.get("scale", [1.0, 1.0, 1.0]), dtype=np.float64)
    matrix[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return matrix


def _primitive(document: dict[str, Any], body: bytes, primitive: dict[str, Any], world_from_node: Array) -> Part:
    attributes = primitive["attributes"]
    local = _accessor(document, body, attributes["POSITION"]).astype(np.float64)
    if local.shape[1] != 3:
        raise ValueError("positions of another size than 3")
    xyz = local @ world_from_node[:3, :3].T + world_from_node[:3, 3]
    if "indices" in primitive:
        corners = _accessor(document, body, primitive["indices"]).astype(np.int64).reshape(-1)
    else:
        corners = np.arange(len(xyz), dtype=np.int64)
    if len(corners) % 3:
        raise ValueError(f"{len(corners)} corners, which make no triangles")
    rgb = None
    if "COLOR_0" in attributes:
        raw = _accessor(document, body, attributes["COLOR_0"])
        share = raw / np.iinfo(raw.dtype).max if raw.dtype.kind == "u" else raw.astype(np.float64)
        if len(share) != len(xyz) or share.shape[1] < 3 or not ((share >= 0) & (share <= 1)).all():
            raise ValueError("colours that do not fit")
        rgb = np.rint(255 * _srgb_from_linear(share[:, :3])).astype(np.uint8)
    return xyz, corners.reshape(-1, 3), rgb


def _accessor(document: dict[str, Any], body: bytes, number: int) -> NDArray[Any]:
    """Return the (count, width) values of an accessor."""
    accessor = document["accessors"][number]
    if "sparse" in accessor:
        raise ValueError("a sparse accessor")
    view = document["bufferViews"][accessor["bufferView"]]
    dtype, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], accessor["count"]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    step = view.get("byteStride", dtype.itemsize * width)
    row = dtype.itemsize * width
    numbers = (start, step, count)
    if (
        not all(isinstance(value, int) for value in numbers)
        or min(numbers) < 0
        or step < row
        or view["buffer"] != 0
    ):
        raise ValueError("an accessor out of its buffer")
    if count and start + step * (count - 1) + row > len(body):
        raise ValueError(f"an accessor that ends after the buffer's {len(body)} bytes")
    return np.ndarray((count, width), dtype, body, start, (step, dtype.itemsize))


def _linear_from_srgb(value: Array) -> Array:
    """IEC 61966-2-1."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _srgb_from_linear(value: Array) -> Array:
    """IEC 61966-2-1."""
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
