"""glTF 2.0 with KHR_gaussian_splatting: .glb (one binary file) and .gltf (JSON; buffers inside or beside).

Gaussians are a primitive of points with the attributes POSITION and, under the extension's prefix, ROTATION
(unit quaternion xyzw), SCALE (world units, not logarithms), OPACITY (0 to 1) and SH_DEGREE_l_COEF_n. glTF is
left, up, front where the PLY is right, down, front: half a turn about z, which changes signs alone. Nodes
place primitives; all Gaussians of the default scene are read, in the order of its nodes. A primitive may hold
an .spz file instead (KHR_gaussian_splatting_compression_spz and _spz_2).

Drafts of the extension stored SCALE as logarithms: a file with a negative scale is taken for such a one.
Source: Khronos' public specification of the extension, release candidate of 2026.
"""

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, BinaryIO
from urllib.parse import unquote

import numpy as np
from msgspec import Meta, Struct

from langsplat_core.arrays import Array, logit, rotation_matrices, sigmoid, unit
from langsplat_core.errors import InputError, malformed, quoted
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import decode_json, is_plain_name, open_for_reading
from langsplat_core.io.packing import coefficient_signs, quaternion_signs, to_bytes
from langsplat_core.io.spz import decode_spz
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.scene.transform import C0, Similarity, similarity, transform_gaussians

EXTENSION = "KHR_gaussian_splatting"
PACKED = (f"{EXTENSION}_compression_spz_2", f"{EXTENSION}_compression_spz")
KNOWN = {EXTENSION, *PACKED, "KHR_mesh_quantization"}  # others that a file requires are refused
COEFFICIENTS = [
    f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for degree in range(4) for n in range(2 * degree + 1)
]
POINTS = 0  # mode of a primitive
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"
JSON_LIMIT = 16 << 20  # bytes; ours has 10 kB
LEAST_ROW = 12  # bytes of a Gaussian: its position
MOST_NODES = 1 << 16
SIGNS = np.array([-1, -1, 1], np.float32)  # left up front to right down front, and back
SRGB = "srgb_rec709_display"

# What is read of the JSON; entries that are not named here are passed over.

Index = Annotated[int, Meta(ge=0, lt=2**40)]
Number = Annotated[float, Meta(ge=-1e30, le=1e30)]


class _View(Struct, rename="camel"):
    buffer: Index
    byte_length: Index
    byte_offset: Index = 0
    byte_stride: Index = 0  # 0: rows follow each other


class _Accessor(Struct, rename="camel"):
    component_type: int
    count: Index
    type: str
    buffer_view: Index | None = None
    byte_offset: Index = 0
    normalized: bool = False
    sparse: Any = None


class _Packed(Struct, rename="camel"):
    buffer_view: Index | None = None


class _Splatting(Struct, rename="camel"):
    color_space: str = SRGB
    extensions: dict[str, _Packed] = {}


class _Primitive(Struct):
    attributes: dict[str, Index]
    mode: int = 4
    extensions: dict[str, _Splatting] = {}


class _Mesh(Struct):
    primitives: list[_Primitive]


class _Node(Struct):
    mesh: Index | None = None
    children: list[Index] = []
    matrix: Annotated[list[Number], Meta(min_length=16, max_length=16)] | None = None  # by columns
    rotation: tuple[Number, Number, Number, Number] = (0, 0, 0, 1)
    scale: tuple[Number, Number, Number] = (1, 1, 1)
    translation: tuple[Number, Number, Number] = (0, 0, 0)


class _Scene(Struct):
    nodes: list[Index] = []


class _Head(Struct, rename="camel"):
    asset: dict[str, Any]
    extensions_required: list[str] = []


class _Content(_Head, rename="camel"):
    accessors: list[_Accessor] = []
    buffer_views: list[_View] = []
    buffers: list[dict[str, Any]] = []
    extensions_used: list[str] = []
    meshes: list[_Mesh] = []
    nodes: Annotated[list[_Node], Meta(max_length=MOST_NODES)] = []
    scene: Index = 0
    scenes: list[_Scene] = []


@np.errstate(all="ignore")  # whatever numbers a file holds: rows that come out unsound are not drawn
def read_gltf_scene(path: Path | str) -> Scene:
    """Return all Gaussians of the default scene of a .glb or .gltf file.

    Raises InputError when a file cannot be opened and FormatError when it breaks a rule of the format, needs
    an extension that is not known here, or holds no Gaussians.
    """
    path = Path(path)
    file = _File(path)
    try:
        parts = list(_parts(file))
    except LookupError as error:
        raise malformed(path, f"names what it lacks ({str(error)[:80]})", "export it again") from None
    if not parts and EXTENSION not in file.content.extensions_used:
        raise malformed(path, f"holds no Gaussians ({EXTENSION}); meshes are not read")
    return Scene(_turned(join_gaussians(parts)))


def _turned(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians half a turn about z further: from glTF's axes to the PLY's, or back."""
    harmonics = np.append(np.float32(1), coefficient_signs(SIGNS, gaussians.sh.shape[1] - 1))
    with np.errstate(invalid="ignore"):
        return replace(
            gaussians,
            means=gaussians.means * SIGNS,
            quats_wxyz=gaussians.quats_wxyz * quaternion_signs(SIGNS),
            sh=gaussians.sh * harmonics[:, None],
        )


def _parts(file: "_File") -> Iterator[Gaussians]:
    """Yield the Gaussians of every primitive that has some, placed by their nodes, along glTF's axes."""
    left = file.size  # bytes that are not shown yet: an honest file has no need to show one again and again
    for place, primitive, splatting in _placed(file):
        if primitive.mode != POINTS:
            raise malformed(file.path, "Gaussians in a primitive that is not of points")
        if splatting.color_space != SRGB:
            raise malformed(file.path, f"colours are not {SRGB} but {quoted(splatting.color_space)}")
        views = [found.buffer_view for name, found in splatting.extensions.items() if name in PACKED]
        packed = views[0] if views else None
        data = b"" if packed is None else file.view(packed)[0]
        count = 0 if packed is not None else file.content.accessors[primitive.attributes["POSITION"]].count
        left -= len(data) + LEAST_ROW * count
        if left < 0:
            raise malformed(file.path, f"shows more Gaussians than {file.size} bytes can hold")
        if packed is not None:
            gaussians = _turned(decode_spz(bytes(data), file.path).gaussians)
        else:
            gaussians = _gaussians(file, primitive.attributes, count)
        try:
            yield gaussians if place.is_identity else transform_gaussians(gaussians, place)
        except InputError as error:
            raise malformed(file.path, str(error)) from None


def _placed(file: "_File") -> Iterator[tuple[Similarity, _Primitive, _Splatting]]:
    """Yield the primitives with Gaussians and where they are. Every node has one parent at most."""
    content = file.content
    roots = content.scenes[content.scene].nodes if content.scenes else range(len(content.nodes))
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        number, above = waiting.pop()
        if number in seen:
            raise malformed(file.path, f"node {number} is in two places or within itself")
        seen.add(number)
        node = content.nodes[number]
        matrix = above @ _matrix(node)
        for primitive in () if node.mesh is None else content.meshes[node.mesh].primitives:
            if EXTENSION in primitive.extensions:
                try:
                    yield similarity(matrix), primitive, primitive.extensions[EXTENSION]
                except InputError as error:
                    raise malformed(file.path, f"node {number}: {error}") from None
        waiting += [(child, matrix) for child in reversed(node.children)]
        if len(waiting) > MOST_NODES:
            raise malformed(file.path, f"more than {MOST_NODES} nodes in its tree")


def _matrix(node: _Node) -> Array:
    """Return the (4, 4) matrix from the axes of a node to those of its parent."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    x, y, z, w = unit(np.array(node.rotation, np.float64), 1e-300)
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrices(np.array([w, x, y, z])) * np.array(node.scale)
    matrix[:3, 3] = node.translation
    return matrix


def _gaussians(file: "_File", attributes: dict[str, int], count: int) -> Gaussians:
    """`count` Gaussians along glTF's axes."""

    def column(name: str, width: int) -> Array:
        return file.accessor(attributes[name], width, count, name)

    have = sum(name in attributes for name in COEFFICIENTS)
    if have not in SH_COUNTS.values() or COEFFICIENTS[have - 1] not in attributes:
        raise malformed(file.path, f"{have} of the coefficients of its colours; expected 1, 4, 9 or 16")
    quats = column(f"{EXTENSION}:ROTATION", 4)
    scales = column(f"{EXTENSION}:SCALE", 3)
    log_scales = scales if (scales < 0).any() else np.log(scales)
    logits = logit(column(f"{EXTENSION}:OPACITY", 1)[:, 0].astype(np.float64))
    sh = np.empty((count, have, 3), np.float32)
    for number, name in enumerate(COEFFICIENTS[:have]):
        sh[:, number] = column(name, 3)
    return Gaussians(column("POSITION", 3), log_scales, quats[:, [3, 0, 1, 2]], logits, sh)


class _File:
    """The JSON of a glTF file and its buffers, whose every entry is checked when it is asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        file, self.size = open_for_reading(path)
        with file:
            start = file.read(12)
            if start[:4] == MAGIC:
                text, self._binary = self._chunks(start, memoryview(file.read()))
            else:
                if self.size > 2**31:
                    raise malformed(path, f"{self.size} bytes of JSON", "write it as .glb")
                text, self._binary = start + file.read(), memoryview(b"")
        head = decode_json(text, _Head, path)
        version = head.asset.get("version")
        if str(version)[:2] != "2.":
            raise malformed(path, f"glTF version {quoted(version)}; only 2 is read", "export it as glTF 2.0")
        for name in head.extensions_required:
            if name not in KNOWN:
                raise malformed(path, f"needs {quoted(name)}, which is not read", "export it without")
        self.content = decode_json(text, _Content, path)
        self._buffers: dict[int, bytes | memoryview] = {}

    def _chunks(self, start: bytes, rest: memoryview) -> tuple[bytes, memoryview]:
        """Return the JSON and the binary chunk of a .glb."""
        version, length = struct.unpack("<II", start[4:]) if len(start) == 12 else (0, 0)
        if version != 2 or length > self.size:
            raise malformed(self.path, f"a .glb of version {version} and {length} bytes, found {self.size}")
        found: list[tuple[bytes, memoryview]] = []
        at = 0
        while at + 8 <= length - 12 and len(found) < 2:
            size, kind = struct.unpack_from("<I4s", rest, at)
            if at + 8 + size > len(rest):
                raise malformed(self.path, f"truncated: a chunk of {size} bytes does not fit")
            found.append((kind, rest[at + 8 : at + 8 + size]))
            at += 8 + size
        if not found or found[0][0] != JSON_CHUNK or len(found[0][1]) > JSON_LIMIT:
            raise malformed(self.path, f"does not begin with a chunk of JSON of at most {JSON_LIMIT} bytes")
        binary = found[1][1] if len(found) == 2 and found[1][0] == BINARY_CHUNK else rest[:0]
        return bytes(found[0][1]), binary

    def accessor(self, index: int, width: int, count: int, name: str) -> Array:
        """Return the (count, width) float32 values of an accessor."""
        about = self.content.accessors[index]
        fits = WIDTHS.get(about.type) == width and about.count == count and about.sparse is None
        if not fits or about.buffer_view is None:
            raise malformed(self.path, f"{name} is not {count} times {width} numbers in a buffer")
        dtype, offset = np.dtype(COMPONENTS[about.component_type]), about.byte_offset
        data, stride = self.view(about.buffer_view)
        row = dtype.itemsize * width
        stride = stride or row
        if not row <= stride <= max(row, 252) or offset + stride * (count - 1) + row > len(data):
            raise malformed(self.path, f"truncated: {name} of {count} Gaussians does not fit its buffer")
        shape, strides = (count, width), (stride, dtype.itemsize)
        values: Array = np.ndarray(shape, dtype, data, offset, strides).astype(np.float32)
        if about.normalized and dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        return values

    def view(self, index: int) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride, 0 where rows follow each other."""
        about = self.content.buffer_views[index]
        data = memoryview(self._buffer(about.buffer))[about.byte_offset :][: about.byte_length]
        if len(data) < about.byte_length:
            raise malformed(self.path, f"truncated: buffer view {index} lies beyond its buffer")
        return data, about.byte_stride

    def _buffer(self, index: int) -> bytes | memoryview:
        if index not in self._buffers:
            uri = self.content.buffers[index].get("uri")
            if uri is None and index == 0:
                self._buffers[index] = self._binary
            elif isinstance(uri, str) and uri.startswith("data:"):
                try:
                    self._buffers[index] = base64.b64decode(uri.partition(";base64,")[2], validate=True)
                except ValueError:
                    raise malformed(self.path, f"buffer {index} is not base64") from None
            else:
                name = unquote(uri) if isinstance(uri, str) else ""
                if not is_plain_name(name):
                    raise malformed(self.path, f"buffer {quoted(uri)} is no plain file name")
                file, size = open_for_reading(self.path.parent / name)
                with file:
                    self.size += size
                    self._buffers[index] = file.read()
        return self._buffers[index]


def write_gltf(path: Path | str, gaussians: Gaussians) -> None:
    """Write a .glb, or a .gltf with its buffer inside, atomically; rows keep their order.

    Positions and colours are exact, scales, quaternions (normalised) and opacities to float32. COLOR_0 shows
    points of the base colour in programs that do not know the extension. A row that cannot be drawn is
    written with opacity 0. Raises InputError for more than a .glb can hold, 4 GiB.
    """
    path = Path(path)
    buffer, columns = BufferWriter(), _columns(gaussians) if len(gaussians) else {}
    attributes = {name: buffer.add(values, name == "POSITION") for name, values in columns.items()}
    content: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "langsplat-viewer"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{}],
    }
    if columns:
        says = {"kernel": "ellipse", "colorSpace": SRGB}
        says |= {"sortingMethod": "cameraDistance", "projection": "perspective"}
        primitive = {"attributes": attributes, "mode": POINTS, "extensions": {EXTENSION: says}}
        content |= {
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [primitive]}],
        } | buffer.content()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        if path.suffix.lower() == ".gltf":
            if columns:
                data = base64.b64encode(b"".join(buffer.blocks)).decode()
                content["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
            file.write(json.dumps(content).encode())
            return
        write_glb(file, content, buffer, path)


class BufferWriter:
    """The one buffer of a glTF file that is written, and the accessors into it."""

    def __init__(self) -> None:
        self.blocks: list[memoryview] = []
        self.size = 0  # bytes, always a multiple of four
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []

    def add(self, values: Array, bounded: bool = False) -> int:
        """Append (N,) or (N, k) values, N > 0, and return the index of their accessor.

        Small integers are fractions of their largest; `bounded` states least and greatest values.
        """
        block = np.ascontiguousarray(values)
        code = next(code for code, kind in COMPONENTS.items() if np.dtype(kind) == block.dtype)
        shape = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[block[0].size]
        about = {"bufferView": len(self._views), "componentType": code, "count": len(block), "type": shape}
        if block.dtype.itemsize < 4:
            about["normalized"] = True
        if bounded:
            about |= {"min": block.min(0).tolist(), "max": block.max(0).tolist()}
        target = 34963 if block.dtype == np.uint32 else 34962  # indices, attributes
        view = {"buffer": 0, "byteOffset": self.size, "byteLength": block.nbytes, "target": target}
        self._accessors.append(about)
        self._views.append(view)
        self.blocks.append(block.data.cast("B"))
        self.size += block.nbytes
        return len(self._accessors) - 1

    def content(self) -> dict[str, Any]:
        """Return the entries of the JSON that describe the buffer."""
        buffers = [{"byteLength": self.size}]
        return {"accessors": self._accessors, "bufferViews": self._views, "buffers": buffers}


def write_glb(file: BinaryIO, content: dict[str, Any], buffer: BufferWriter, path: Path) -> None:
    """Write a .glb; InputError, naming `path`, for more than one can hold."""
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary = struct.pack("<I", buffer.size) + BINARY_CHUNK if buffer.size else b""
    whole = 20 + len(text) + len(binary) + buffer.size
    if whole >= 2**32:
        raise InputError(f"{path}: {whole} bytes are more than a .glb can hold; write .spz or .sog")
    file.write(MAGIC + struct.pack("<III", 2, whole, len(text)) + JSON_CHUNK + text + binary)
    file.writelines(buffer.blocks)


def _columns(gaussians: Gaussians) -> dict[str, Array]:
    """Attribute -> (N, ...) values along glTF's axes; rows that cannot be drawn are harmless."""
    valid = gaussians.valid()
    keep = valid[:, None]
    turned = _turned(gaussians)
    quats = unit(np.where(keep, turned.quats_wxyz, [1, 0, 0, 0]).astype(np.float64), 1e-30)
    opacity = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    sh = np.where(keep[..., None], turned.sh, 0)
    base = np.concatenate([0.5 + C0 * sh[:, 0], opacity[:, None]], axis=1)
    columns = {
        "POSITION": np.where(keep, turned.means, 0).astype("<f4"),
        "COLOR_0": to_bytes(255 * base),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]].astype("<f4"),
        f"{EXTENSION}:SCALE": np.exp(np.where(keep, turned.log_scales, 0).astype(np.float64)).astype("<f4"),
        f"{EXTENSION}:OPACITY": opacity.astype("<f4"),
    }
    return columns | {name: sh[:, k].astype("<f4") for k, name in enumerate(COEFFICIENTS[: sh.shape[1]])}
