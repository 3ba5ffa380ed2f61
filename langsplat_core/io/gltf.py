"""glTF 2.0 with KHR_gaussian_splatting: .glb (one binary file) and .gltf (JSON; buffers inside or beside).

Gaussians are a primitive of points with the attributes POSITION and, under the extension's prefix, ROTATION
(unit quaternion xyzw), SCALE (world units, not logarithms), OPACITY (0 to 1) and SH_DEGREE_l_COEF_n. Axes of
glTF are left, up, front, those of the PLY right, down, front: half a turn about z, which only changes signs.
Nodes place primitives; all Gaussians of the default scene are read, in the order of its nodes. A primitive
may hold an .spz file instead (KHR_gaussian_splatting_compression_spz and _spz_2).

In files of this program the node turns the scene upright, y up, and scales it to metres if the scale is
known; its extras undo that unless the node was moved. In drafts SCALE, then partly negative, is a logarithm.
All other content is ignored and reported. Source: Khronos' specification as ratified in 2026.
"""

import base64
import json
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote

import numpy as np
from msgspec import Meta, Struct, ValidationError, convert, to_builtins

from langsplat_core.arrays import Array, affine, linear_light, logit, rotation_matrices, sigmoid, unit
from langsplat_core.errors import InputError, malformed, quoted, report_losses, unread
from langsplat_core.io import hostile
from langsplat_core.io.files import atomic_path
from langsplat_core.io.quantised import mirrored
from langsplat_core.io.spz import decode_spz
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene, about_origin, transform
from langsplat_core.scene.gaussians import join_gaussians

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
JSON_LIMIT = 16 << 20  # bytes; files of this program have 10 kB
MOST_NODES = 1 << 16
SIGNS = np.array([-1, -1, 1], np.float32)  # left, up, front to right, down, front, and back
OWN = "langsplat"  # key in the extras of a node
SRGB = "srgb_rec709_display"
HOW = ("ellipse", "cameraDistance", "perspective")  # kernel, order and projection of this program

# Entries of the JSON that are read.

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
    kernel: str = HOW[0]
    sorting_method: str = HOW[1]
    projection: str = HOW[2]
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
    extensions: dict[str, Any] = {}
    extras: Any = None  # anything


class Kept(Struct):
    """Properties of a scene in the extras of a node, and the node's matrix as it was written."""

    matrix: list[Number] | None = None
    origin: tuple[Number, Number, Number] = (0, 0, 0)
    metres_per_unit: Annotated[float, Meta(gt=0, le=1e12)] | None = None
    antialiased: bool = False

    def given(self, scene: Scene) -> Scene:
        """Return the scene, read without the node's matrix, with these properties."""
        metres, origin = self.metres_per_unit, np.array(self.origin)
        return replace(scene, antialiased=self.antialiased, metres_per_unit=metres, origin=origin)


class _Scene(Struct):
    nodes: list[Index] = []


class _About(Struct, rename="camel"):
    asset: dict[str, Any]
    extensions_required: list[str] = []


class _Content(Struct, rename="camel"):
    accessors: list[_Accessor] = []
    buffer_views: list[_View] = []
    buffers: list[dict[str, Any]] = []
    extensions_used: list[str] = []
    meshes: list[_Mesh] = []
    nodes: Annotated[list[_Node], Meta(max_length=MOST_NODES)] = []
    scene: Index | None = None
    scenes: list[_Scene] = []


# Known entries. "materials" are of meshes, or for viewers without the extension.
ENTRIES = {*_Content.__struct_encode_fields__, *_About.__struct_encode_fields__, "materials"}


@np.errstate(all="ignore")  # rows of invalid numbers are not drawn
def read_gltf_scene(path: Path | str) -> Scene:
    """Return all Gaussians of the default scene of a .glb or .gltf file.

    `antialiased` is set if all come from .spz files with that flag. Raises InputError if a file cannot be
    opened and FormatError if it breaks a rule of the format, needs an unknown extension, or has no Gaussians.
    """
    path = Path(path)
    file = _File(path)
    try:
        scene = placed_scene(path, _parts(file))
    except LookupError as error:
        raise malformed(path, f"names what it lacks ({str(error)[:80]})", "export it again") from None
    if not len(scene.gaussians) and EXTENSION not in file.content.extensions_used:
        raise malformed(path, f"holds no Gaussians ({EXTENSION}); meshes are not read")
    report_losses(path, file.losses())
    scene = replace(scene, antialiased=file.antialiased == {True})
    return scene if file.kept is None else file.kept.given(scene)


@np.errstate(all="ignore")
def placed_scene(path: Path, parts: Iterable[tuple[Array, Gaussians]]) -> Scene:
    """Return the scene of `parts`: Gaussians in glTF's axes, each with a (4, 4) matrix that places them."""
    middle, placed = None, []
    for matrix, gaussians in parts:
        if middle is None:  # positions are relative to the first: world positions may exceed float32
            middle = matrix[:3, 3].copy()
        try:
            place = transform.similarity(matrix).then(transform.moving(-middle))
            placed.append(gaussians if place.is_identity else transform.transform_gaussians(gaussians, place))
        except InputError as error:
            raise malformed(path, str(error)) from None
    gaussians = mirrored(join_gaussians(placed), SIGNS)
    if middle is None or not middle.any():
        return Scene(gaussians)
    means, origin = about_origin(gaussians.means + SIGNS * middle)
    return Scene(replace(gaussians, means=means), origin=origin)


def _parts(file: "_File") -> Iterator[tuple[Array, Gaussians]]:
    """Yield the Gaussians of every primitive, in glTF's axes, and the matrix that places them."""
    for matrix, primitive in _placed(file):
        if EXTENSION not in primitive.extensions:
            file.bare += 1
            continue
        splatting = primitive.extensions[EXTENSION]
        if primitive.mode != POINTS:
            raise malformed(file.path, "Gaussians in a primitive that is not of points")
        if splatting.color_space != SRGB:
            raise malformed(file.path, f"colours are not {SRGB} but {quoted(splatting.color_space)}")
        how = splatting.kernel, splatting.sorting_method, splatting.projection
        file.others.update(quoted(name) for name in {*how} - {*HOW} | splatting.extensions.keys() - {*PACKED})
        views = (own.buffer_view for name, own in splatting.extensions.items() if name in PACKED)
        packed = next(views, None)
        if packed is not None:
            data = bytes(file.view(packed)[0])
            file.room.take(1 << 16)  # bounds the number of small ones, too
            inside = decode_spz(data, file.path, file.room, file.told.append)
            gaussians = mirrored(inside.gaussians, SIGNS)
            file.antialiased.add(inside.antialiased)
        else:
            file.antialiased.add(False)
            gaussians = _gaussians(file, primitive.attributes)
        yield matrix, gaussians


def _placed(file: "_File") -> Iterator[tuple[Array, _Primitive]]:
    """Yield the primitives and the matrices that place them; FormatError if a node has two parents."""
    content = file.content
    roots = content.scenes[content.scene or 0].nodes if content.scenes else range(len(content.nodes))
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    seen: set[int] = set()
    while waiting:
        number, above = waiting.pop()
        if number in seen or len(waiting) > MOST_NODES:
            raise malformed(file.path, f"node {number} is in two places, within itself or one of too many")
        seen.add(number)
        node = content.nodes[number]
        matrix = above @ _matrix(node)
        with suppress(LookupError, TypeError, ValidationError):  # extras may be anything
            kept = convert(node.extras[OWN], Kept)
            if len(content.nodes) == 1 and kept.matrix == node.matrix:
                file.kept, matrix = kept, np.eye(4)
        file.others.update(map(quoted, node.extensions))
        if node.mesh is not None:
            file.shown.add(node.mesh)
            yield from ((matrix, primitive) for primitive in content.meshes[node.mesh].primitives)
        waiting += [(child, matrix) for child in reversed(node.children)]


def _matrix(node: _Node) -> Array:
    """Return the (4, 4) matrix from the axes of a node to those of its parent."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    x, y, z, w = unit(np.array(node.rotation, np.float64), 1e-300)
    linear = rotation_matrices(np.array([w, x, y, z])) * np.array(node.scale)
    return affine(linear, np.array(node.translation))


def _gaussians(file: "_File", attributes: dict[str, int]) -> Gaussians:
    """Return Gaussians in glTF's axes."""
    count = file.content.accessors[attributes["POSITION"]].count

    def column(name: str, width: int) -> Array:
        return file.accessor(attributes[name], width, count, name)

    have = sum(name in attributes for name in COEFFICIENTS)
    if have not in SH_COUNTS.values() or COEFFICIENTS[have - 1] not in attributes:
        raise malformed(file.path, f"{have} of the coefficients of its colours; expected 1, 4, 9 or 16")
    parts = rotation, scale, opacity = [f"{EXTENSION}:{part}" for part in ("ROTATION", "SCALE", "OPACITY")]
    file.others.update(map(quoted, attributes.keys() - {"POSITION", "COLOR_0", *parts, *COEFFICIENTS}))
    quats = column(rotation, 4)
    log_scales = column(scale, 3)
    if (log_scales < 0).any():
        file.told.append("some scales are negative, and all are taken for logarithms, as of a draft")
    else:
        log_scales = np.log(log_scales)
    logits = logit(column(opacity, 1)[:, 0].astype(np.float64))
    sh = np.empty((count, have, 3), np.float32)
    for number, name in enumerate(COEFFICIENTS[:have]):
        sh[:, number] = column(name, 3)
    return Gaussians(column("POSITION", 3), log_scales, quats[:, [3, 0, 1, 2]], logits, sh)


class _File:
    """The JSON of a glTF file and its buffers; entries are checked when they are read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.told: list[str] = []  # lines about what was ignored or guessed
        self.others: set[str] = set()  # unknown attributes, extensions and ways of drawing
        self.bare = 0  # placed primitives without Gaussians
        self.shown: set[int] = set()  # meshes that nodes place
        self.antialiased: set[bool] = set()  # flags of primitives
        self.kept: Kept | None = None  # of a scene of this program whose node was not moved
        text = memoryview(hostile.read_file(path, 2**32))
        self._binary = text[:0]
        # Allowances for plain numbers, which real files use once or a few times, and for packed Gaussians
        self._shown = hostile.Allowance(path, len(text), 1, hostile.FREE // 4)
        self.room = hostile.Allowance(path, len(text), hostile.SMALL_RATIO)
        self._buffers: dict[int, bytes | memoryview] = {}
        if text[:4] == MAGIC:  # then version, length; size and kind of a chunk; JSON; the same of the buffer
            end = 20 + int.from_bytes(text[12:16], "little")
            if text[4:8] != b"\2\0\0\0" or text[16:20] != JSON_CHUNK or end - 20 > JSON_LIMIT:
                raise malformed(path, f"does not begin with a chunk of JSON of at most {JSON_LIMIT} bytes")
            size = int.from_bytes(text[end : end + 4], "little")
            size = size + 8 if text[end + 4 : end + 8] == BINARY_CHUNK else 0
            self._binary = text[end + 8 : end + size]
            if len(text) - end - size > 3:
                self.told.append(f"{len(text) - end - size} bytes behind its buffer not read")
            text = text[20:end]
        about = hostile.decode_json(bytes(text), _About, path)  # first: other versions have other content
        version = about.asset.get("version")
        if str(version)[:2] != "2.":
            raise malformed(path, f"glTF version {quoted(version)}; only 2 is read", "export it as glTF 2.0")
        for name in about.extensions_required:
            if name not in KNOWN:
                raise malformed(path, f"needs {quoted(name)}, which is not read", "export it without")
        self.content = hostile.decode_json(bytes(text), _Content, path)
        self.told.append(hostile.other_entries(bytes(text), ENTRIES, path))

    def losses(self) -> Iterator[str]:
        """Yield lines about what was ignored or guessed, after the Gaussians were read."""
        yield from dict.fromkeys(self.told)
        yield unread("", self.others)
        if self.bare:
            yield f"{self.bare} primitives without Gaussians not read"
        meshes = (mesh for number, mesh in enumerate(self.content.meshes) if number not in self.shown)
        if hidden := sum(EXTENSION in one.extensions for mesh in meshes for one in mesh.primitives):
            yield f"{hidden} primitives of Gaussians are not in its default scene"
        if self.content.scene is None and len(self.content.scenes) > 1:
            yield f"the first of its {len(self.content.scenes)} scenes is taken, as none is its default"
        if len(self.antialiased) > 1:
            yield "a part of its Gaussians is antialiased, and none is drawn so"

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
        self._shown.take(max(count * row, 512))  # bounds the number of small ones, too
        shape, strides = (count, width), (stride, dtype.itemsize)
        values: Array = np.ndarray(shape, dtype, data, offset, strides).astype(np.float32)
        if about.normalized and dtype.kind in "iu":
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        return values

    def view(self, index: int) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view and its stride, 0 for contiguous rows."""
        about = self.content.buffer_views[index]
        data = memoryview(self._buffer(about.buffer))[about.byte_offset :][: about.byte_length]
        if len(data) < about.byte_length:
            raise malformed(self.path, f"truncated: buffer view {index} lies beyond its buffer")
        return data, about.byte_stride

    def _buffer(self, index: int) -> bytes | memoryview:
        if index not in self._buffers:
            uri = self.content.buffers[index].get("uri")
            scheme, _, data = str(uri).partition(";base64,")
            if uri is None and index == 0:
                self._buffers[index] = self._binary
            elif scheme.startswith("data:"):
                try:
                    self._buffers[index] = base64.b64decode(data, validate=True)
                except ValueError:
                    raise malformed(self.path, f"buffer {index} is not base64") from None
            elif hostile.is_plain_name(name := unquote(str(uri))):
                self._buffers[index] = hostile.read_file(self.path.parent / name, 2**32)
                self._shown.left += len(self._buffers[index])
                self.room.left += hostile.SMALL_RATIO * len(self._buffers[index])
            else:
                raise malformed(self.path, f"buffer {quoted(uri)} is no plain file name")
        return self._buffers[index]


def write_gltf(path: Path | str, scene: Scene) -> None:
    """Write a .glb, or a .gltf with its buffer inside, atomically; rows keep their order.

    Positions and colours are exact; scales, quaternions (normalised) and opacities are rounded to float32.
    COLOR_0 is the linear base colour. What cannot be drawn gets opacity 0. InputError beyond 4 GiB.
    """
    file, gaussians = GltfWriter(EXTENSION), scene.gaussians
    if len(gaussians):
        columns = attributes_of(gaussians).items()
        attributes = {name: file.add(values, name == "POSITION") for name, values in columns}
        splatting = dict(zip(("kernel", "sortingMethod", "projection"), HOW, strict=True))
        extensions = {EXTENSION: splatting | {"colorSpace": SRGB}}
        primitive = {"attributes": attributes, "mode": POINTS, "extensions": extensions}
        file.add_mesh(primitive, **node_of(scene))
    file.write(Path(path))


def node_of(scene: Scene) -> dict[str, Any]:
    """Return the entries of the node of a scene, whose content is in glTF's axes relative to its origin.

    Its matrix turns the scene's up to y, and scales to metres if the scale is known; its extras say how.
    """
    turn = transform.turning(SIGNS * scene.up(), transform.AXES["y"])
    there = turn.then(transform.moving(transform.turned_origin(turn.rotation * SIGNS, scene.origin)))
    there = there.then(transform.scaling(scene.metres_per_unit or 1.0))
    matrix = None if there.is_identity else there.matrix.T.reshape(-1).tolist()
    kept = Kept(matrix, tuple(scene.origin.tolist()), scene.metres_per_unit, scene.antialiased)
    said = {"matrix": matrix} if matrix else {}
    return said if kept == Kept() else {**said, "extras": {OWN: to_builtins(kept)}}


class GltfWriter:
    """A glTF file under construction: nodes with a mesh each, and one buffer."""

    def __init__(self, extension: str) -> None:
        self._content: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "langsplat-viewer"},
            "extensionsUsed": [extension],
            "scene": 0,
            "scenes": [{}],
        }
        self._blocks: list[memoryview] = []
        self._size = 0  # bytes, always a multiple of four

    def add(self, values: Array, bounded: bool = False) -> int:
        """Append (N,) or (N, k) values, N > 0, and return the index of their accessor.

        Integers of less than 4 bytes are marked as normalised; bounded: with least and greatest values.
        """
        block = np.ascontiguousarray(values)
        views, accessors = (self._content.setdefault(key, []) for key in ("bufferViews", "accessors"))
        code = next(code for code, kind in COMPONENTS.items() if np.dtype(kind) == block.dtype)
        shape = next(shape for shape, width in WIDTHS.items() if width == block[0].size)
        about = {"bufferView": len(views), "componentType": code, "count": len(block), "type": shape}
        if block.dtype.itemsize < 4:
            about["normalized"] = True
        if bounded:
            about |= {"min": block.min(0).tolist(), "max": block.max(0).tolist()}
        target = 34963 if block.dtype == np.uint32 else 34962  # indices, attributes
        views.append({"buffer": 0, "byteOffset": self._size, "byteLength": block.nbytes, "target": target})
        accessors.append(about)
        self._blocks.append(block.data.cast("B"))
        self._size += block.nbytes
        return len(accessors) - 1

    def add_mesh(self, primitive: dict[str, Any], **more: Any) -> None:
        """Add a node with `more` entries, and its mesh of one primitive."""
        nodes, meshes = (self._content.setdefault(key, []) for key in ("nodes", "meshes"))
        meshes.append({"primitives": [primitive]})
        nodes.append({"mesh": len(nodes), **more})
        self._content["scenes"] = [{"nodes": list(range(len(nodes)))}]

    def write(self, path: Path, **more: Any) -> None:
        """Write a .gltf, or else a .glb, atomically, with `more` entries; InputError beyond 4 GiB."""
        content = self._content | more
        if self._size:
            content["buffers"] = [{"byteLength": self._size}]
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            if path.suffix.lower() == ".gltf":
                if self._size:
                    data = base64.b64encode(b"".join(self._blocks)).decode()
                    content["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{data}"
                file.write(json.dumps(content).encode())
                return
            text = json.dumps(content).encode()
            text += b" " * (-len(text) % 4)
            binary = struct.pack("<I", self._size) + BINARY_CHUNK if self._size else b""
            whole = 20 + len(text) + len(binary) + self._size
            if whole >= 2**32:
                raise InputError(f"{path}: {whole} bytes are more than a .glb can hold; write .spz or .sog")
            file.write(MAGIC + struct.pack("<III", 2, whole, len(text)) + JSON_CHUNK + text + binary)
            file.writelines(self._blocks)


def attributes_of(gaussians: Gaussians) -> dict[str, Array]:
    """Return attribute -> (N, ...) values in glTF's axes; rows that cannot be drawn get opacity 0."""
    valid = gaussians.valid()
    keep = valid[:, None]
    turned = mirrored(gaussians, SIGNS)
    quats = unit(np.where(keep, turned.quats_wxyz, [1, 0, 0, 0]).astype(np.float64), 1e-30)
    opacity = np.where(valid, sigmoid(gaussians.opacity_logits.astype(np.float64)), 0)
    sh = np.where(keep[..., None], turned.sh, 0)
    light = linear_light(np.clip(0.5 + transform.C0 * sh[:, 0], 0, 1))
    base = np.concatenate([light, opacity[:, None]], axis=1)
    columns = {
        "POSITION": np.where(keep, turned.means, 0).astype("<f4"),
        "COLOR_0": np.rint(65_535 * base).astype("<u2"),
        f"{EXTENSION}:ROTATION": quats[:, [1, 2, 3, 0]].astype("<f4"),
        f"{EXTENSION}:SCALE": np.exp(np.where(keep, turned.log_scales, 0).astype(np.float64)).astype("<f4"),
        f"{EXTENSION}:OPACITY": opacity.astype("<f4"),
    }
    return columns | {name: sh[:, k].astype("<f4") for k, name in enumerate(COEFFICIENTS[: sh.shape[1]])}
