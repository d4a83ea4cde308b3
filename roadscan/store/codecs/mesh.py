"""Writes and checks triangle meshes as binary glTF and PLY."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from blake3 import blake3

from roadscan.core.errors import StoreError

_GLTF: Final = 0x46546C67  # "glTF", magic number of the file
_JSON: Final = 0x4E4F534A  # "JSON", type of a chunk
_BIN: Final = 0x004E4942  # "BIN", type of a chunk
_DIGEST: Final = "blake3"
_UNLIT: Final = "KHR_materials_unlit"


@dataclass(frozen=True)
class Mesh:
    """Vertices with their colours, and the triangles between them."""

    vertices_m: npt.NDArray[np.float32]
    """(n, 3) east, north, up from the mesh's origin (m)."""
    colour: npt.NDArray[np.uint8]
    """(n,) grey of an intensity, or (n, 3) red, green, blue of a picture (sRGB)."""
    triangles: npt.NDArray[np.uint32]
    """(m, 3) vertices, counter-clockwise as seen from above."""


def write_glb(path: Path, mesh: Mesh, about: Mapping[str, Any], generator: str) -> None:
    """Write binary glTF 2.0 (Khronos, *glTF 2.0 Specification*, chapter 4): y up, so x is east and z is south.

    Colours of vertices are linear there (section 3.9.2): an intensity is taken as linear, a picture's colours are made
    so, in 16 bits, which keep its 256 steps apart. Their light is that of the picture: they are shown without another
    (KHR_materials_unlit).

    Parameters
    ----------
    about : content of `asset.extras`, beside the digest of the arrays.
    """
    upright = mesh.vertices_m[:, [0, 2, 1]] * np.array([1, 1, -1], np.float32)
    arrays = [upright.astype("<f4").tobytes(), _linear(mesh.colour).tobytes(), mesh.triangles.astype("<u4").tobytes()]
    content = b"".join(arrays)
    described: dict[str, Any] = {
        "asset": {
            "version": "2.0",
            "generator": generator,
            "extras": {**about, _DIGEST: blake3(content).hexdigest(length=16)},
        },
        "scene": 0,
        "scenes": [{}],
    }
    if len(mesh.triangles):
        described |= _described(mesh, upright, [len(a) for a in arrays])
    text = json.dumps(described, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), _JSON) + text
    if content:
        chunks += struct.pack("<II", len(content), _BIN) + content
    path.write_bytes(struct.pack("<III", _GLTF, 2, 12 + len(chunks)) + chunks)


def _linear(colour: npt.NDArray[np.uint8]) -> npt.NDArray[np.unsignedinteger[Any]]:
    """Return linear red, green, blue and opacity (n, 4): uint8 of greys (n,), uint16 of colours (n, 3).

    sRGB to linear: IEC 61966-2-1, section 5.2.
    """
    if colour.ndim == 1:
        grey = np.repeat(colour[:, None], 4, axis=1)
        grey[:, 3] = 255
        return grey
    encoded = np.arange(256) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    out = np.full((len(colour), 4), 65_535, "<u2")
    out[:, :3] = np.rint(65_535.0 * linear).astype("<u2")[colour]
    return out


def _described(mesh: Mesh, upright: npt.NDArray[np.float32], sizes: list[int]) -> dict[str, Any]:
    """Return scene, mesh and arrays of the file as JSON values."""
    vertices, colours, triangles = sizes
    views = [
        {"buffer": 0, "byteOffset": 0, "byteLength": vertices, "target": 34962},
        {"buffer": 0, "byteOffset": vertices, "byteLength": colours, "target": 34962},
        {"buffer": 0, "byteOffset": vertices + colours, "byteLength": triangles, "target": 34963},
    ]
    low, high = (bound.astype(float).tolist() for bound in (upright.min(axis=0), upright.max(axis=0)))
    count, of_pictures = len(upright), mesh.colour.ndim == 2
    kind = 5123 if of_pictures else 5121
    unlit: dict[str, Any] = {"extensions": {_UNLIT: {}}} if of_pictures else {}
    matt = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0}, "doubleSided": True}
    return {
        **({"extensionsUsed": [_UNLIT]} if of_pictures else {}),
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [matt | unlit],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3", "min": low, "max": high},
            {"bufferView": 1, "componentType": kind, "normalized": True, "count": count, "type": "VEC4"},
            {"bufferView": 2, "componentType": 5125, "count": 3 * len(mesh.triangles), "type": "SCALAR"},
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": sum(sizes)}],
    }


def check_glb(path: Path) -> None:
    """Raise :class:`StoreError` unless the file is complete and its arrays are those that were written."""
    content = path.read_bytes()
    try:
        magic, version, size, length, kind = struct.unpack_from("<IIIII", content)
        described = json.loads(content[20 : 20 + length])
        arrays = content[28 + length :]
        digest = described["asset"]["extras"][_DIGEST]
    except (struct.error, ValueError, KeyError, TypeError) as error:
        raise StoreError("the glTF is cut short", change="make it again", file=path) from error
    if (magic, version, size, kind) != (_GLTF, 2, len(content), _JSON) or digest != blake3(arrays).hexdigest(length=16):
        raise StoreError("the glTF is damaged", change="make it again", file=path)


def stated_in_glb(content: bytes) -> dict[str, Any]:
    """Return what a glTF file states about its mesh (`asset.extras`)."""
    try:
        described = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
        stated: dict[str, Any] = described["asset"]["extras"]
    except (ValueError, KeyError, TypeError) as error:
        raise StoreError("the glTF is cut short", change="make it again") from error
    return stated


def write_ply(path: Path, mesh: Mesh, about: Mapping[str, Any]) -> None:
    """Write binary little-endian PLY 1.0 (Turk 1994): x east, y north, z up, red, green, blue as screens show them.

    Parameters
    ----------
    about : comments of the header, beside the digest of what follows it.
    """
    vertices = np.empty(len(mesh.vertices_m), [("place", "<f4", 3), ("colour", "u1", 3)])
    vertices["place"], vertices["colour"] = mesh.vertices_m, mesh.colour.reshape(len(vertices), -1)
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, mesh.triangles
    content = vertices.tobytes() + faces.tobytes()
    comments = {**about, _DIGEST: blake3(content).hexdigest(length=16)}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {name} {json.dumps(value)}" for name, value in comments.items()),
        f"element vertex {len(vertices)}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    path.write_bytes("\n".join(lines).encode("ascii") + b"\n" + content)


def check_ply(path: Path) -> None:
    """Raise :class:`StoreError` unless the file is complete and its arrays are those that were written."""
    head, end, content = path.read_bytes().partition(b"end_header\n")
    stated = f'comment {_DIGEST} "{blake3(content).hexdigest(length=16)}"'.encode()
    if not head.startswith(b"ply\n") or not end or stated not in head.split(b"\n"):
        raise StoreError("the PLY is damaged", change="make it again", file=path)
