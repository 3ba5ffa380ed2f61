"""Encoders of formats that are only read, small files of every kind, and comparisons after a round trip.

They are written from the published layouts, apart from the readers: a test misses what is wrong in both.
"""

import gzip
import io
import json
import math
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import pytest
import torch
import zstandard
from PIL import Image
from torch import nn

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.errors import STRICTNESS, FormatError, InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    AutoencoderCodec,
    CodebookCodec,
    Codec,
    Gaussians,
    LanguageField,
    LinearCodec,
    Tree,
)
from langsplat_core.scene.transform import sh_basis

T = TypeVar("T")
C0 = 0.28209479177387814


def inria_names(sh_degree: int, normals: bool = True) -> list[str]:
    """Property names in the order of the INRIA code."""
    numbered = {"f_dc": 3, "f_rest": 3 * ((sh_degree + 1) ** 2 - 1), "scale": 3, "rot": 4}
    dc, rest, scale, rot = ([f"{name}_{i}" for i in range(n)] for name, n in numbered.items())
    return [*"xyz", *(["nx", "ny", "nz"] if normals else []), *dc, *rest, "opacity", *scale, *rot]


def columns(g: Gaussians) -> dict[str, Array]:
    """INRIA property name -> (N,) values, written out one by one."""
    out = {name: g.means[:, i] for i, name in enumerate("xyz")}
    out |= {name: np.zeros(len(g), np.float32) for name in ("nx", "ny", "nz")}
    out |= {f"f_dc_{i}": g.sh[:, 0, i] for i in range(3)}
    higher = g.sh.shape[1] - 1
    for channel in range(3):
        for k in range(higher):
            out[f"f_rest_{channel * higher + k}"] = g.sh[:, 1 + k, channel]
    out["opacity"] = g.opacity_logits
    out |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    out |= {f"rot_{i}": g.quats_wxyz[:, i] for i in range(4)}
    return out


def ply_bytes(header: list[str], body: bytes, newline: str = "\n") -> bytes:
    return (newline.join(["ply", *header, "end_header"]) + newline).encode() + body


def vertex_table(g: Gaussians, names: list[str], code: str = "<f4") -> Array:
    values, table = columns(g), np.zeros(len(g), [(name, code) for name in names])
    for name in names:
        table[name] = values.get(name, 7.0)  # 7: a property that is none of ours
    return table


def plain_ply(g: Gaussians, names: list[str] | None = None, *, newline: str = "\n") -> bytes:
    """Binary little endian."""
    names = names or inria_names(g.sh_degree)
    header = ["format binary_little_endian 1.0", f"element vertex {len(g)}"]
    header += [f"property float {name}" for name in names]
    return ply_bytes(header, vertex_table(g, names).tobytes(), newline)


def ascii_ply(g: Gaussians) -> bytes:
    """With an element of two lines, one of them a list, in front, and a blank line."""
    names = inria_names(g.sh_degree, normals=False)
    header = ["format ascii 1.0", "element face 2", "property list uchar int vertex_indices"]
    header += [f"element vertex {len(g)}", *(f"property float {name}" for name in names)]
    rows = vertex_table(g, names).tolist()
    lines = ["3 0 1 2", "4 0 1 2 3", "", *(" ".join(repr(value) for value in row) for row in rows)]
    return ply_bytes(header, "\n".join(lines).encode())


def mixed_ply(g: Gaussians) -> bytes:
    """Big endian doubles, an extra property in front and one of another type behind, a further element."""
    names = inria_names(g.sh_degree, normals=False)
    table = vertex_table(g, ["segment", *names], ">f8")
    mixed = np.zeros(len(g), [*table.dtype.descr, ("id", ">u2")])
    for name in table.dtype.names:
        mixed[name] = table[name]
    header = ["format binary_big_endian 1.0", "comment antialiased 1", f"element vertex {len(g)}"]
    header += [f"property double {name}" for name in table.dtype.names]
    header += ["property ushort id", "element camera 1", "property float focal"]
    return ply_bytes(header, mixed.tobytes() + b"\0\0\0\1")


def _fields(values: Array, bits: tuple[int, ...]) -> Array:
    """Map (N, len(bits)) fractions in [0, 1] to (N,) uint32, the first field on top."""
    packed = np.zeros(len(values), np.uint32)
    for column, width in enumerate(bits):
        code = np.floor(values[:, column] * (2**width - 1) + 0.5).astype(np.uint32)
        packed = (packed << np.uint32(width)) | code
    return packed


def _three(g: Gaussians) -> tuple[Array, Array]:
    """(N, 3) the components of quaternions whose largest is positive, without that one, and which that is."""
    quats = unit(g.quats_wxyz.astype(np.float64))
    largest = np.abs(quats).argmax(1)
    quats *= np.sign(np.take_along_axis(quats, largest[:, None], 1))
    return np.array([np.delete(q, i) for q, i in zip(quats, largest, strict=True)]), largest


def compressed_ply(g: Gaussians, *, colours: bool = True) -> bytes:
    """SuperSplat's compressed PLY; without `colours` the chunks have the 12 older columns."""
    starts = range(0, len(g), 256)
    blocks = {"position": g.means, "scale": g.log_scales, "colour": 0.5 + C0 * g.sh[:, 0]}
    bounds, fractions = [], {key: np.zeros_like(block, np.float64) for key, block in blocks.items()}
    for start in starts:
        rows, row = slice(start, start + 256), []
        for key, block in blocks.items():
            if key == "colour" and not colours:
                fractions[key][rows] = np.clip(block[rows], 0, 1)
                continue
            low, high = block[rows].min(0), block[rows].max(0)
            fractions[key][rows] = (block[rows].astype(np.float64) - low) / np.maximum(high - low, 1e-12)
            row += [low, high]
        bounds.append(np.concatenate(row))
    three, largest = _three(g)
    rotation = _fields(three / np.sqrt(2) + 0.5, (10, 10, 10)) | (largest.astype(np.uint32) << 30)
    opacity = sigmoid(g.opacity_logits.astype(np.float64))[:, None]
    packed = [
        _fields(fractions["position"], (11, 10, 11)),
        rotation,
        _fields(fractions["scale"], (11, 10, 11)),
        _fields(np.concatenate([fractions["colour"], opacity], 1), (8, 8, 8, 8)),
    ]
    axes = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    scales = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    rgb = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"] if colours else []
    header = ["format binary_little_endian 1.0", "comment made by a test", f"element chunk {len(bounds)}"]
    header += [f"property float {name}" for name in axes + scales + rgb]
    header += [f"element vertex {len(g)}"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    body = np.array(bounds, "<f4").tobytes() + np.stack(packed, 1).astype("<u4").tobytes()
    if g.sh_degree:
        rest = np.stack([v for name, v in columns(g).items() if name.startswith("f_rest_")], 1)
        header += [f"element sh {len(g)}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
        body += np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes()
    return ply_bytes(header, body)


def _webp(pixels: Array) -> bytes:
    buffer = io.BytesIO()
    # exact: else the encoder may change colours under alpha 0
    Image.fromarray(pixels.astype(np.uint8)).save(buffer, "WEBP", lossless=True, exact=True)
    return buffer.getvalue()


def _plane(codes: Array, width: int) -> Array:
    """Map (N, C) codes to (H, W, C) with zero pixels at the end."""
    height = -(-len(codes) // width)
    out = np.zeros((height * width, codes.shape[1]), np.uint8)
    out[: len(codes)] = codes
    return out.reshape(height, width, -1)


def _nearest(values: Array, codebook: Array) -> Array:
    return np.abs(values[..., None] - codebook).argmin(-1).astype(np.uint8)


def sog_files(g: Gaussians, palette_entries: int = 70) -> dict[str, bytes]:
    """SOG version 2 with linear codebooks; Gaussian i has palette entry i modulo `palette_entries`."""
    width = 12
    logs = np.sign(g.means) * np.log1p(np.abs(g.means.astype(np.float64)))
    mins, maxs = logs.min(0), logs.max(0)
    code = np.round((logs - mins) / (maxs - mins) * 65535).astype(np.uint32)
    three, largest = _three(g)
    packed = np.concatenate([np.round((three / np.sqrt(2) + 0.5) * 255), 252 + largest[:, None]], 1)
    packed = _plane(packed, width)
    packed[..., 3] = np.maximum(packed[..., 3], 252)  # the padding too
    books = {
        "scales": np.linspace(g.log_scales.min(), g.log_scales.max(), 256),
        "sh0": np.linspace(g.sh[:, 0].min(), g.sh[:, 0].max(), 256),
        "shN": np.linspace(-1, 1, 256),
    }
    alpha = np.round(sigmoid(g.opacity_logits.astype(np.float64)) * 255)[:, None]
    sh0 = np.concatenate([_nearest(g.sh[:, 0], books["sh0"]), alpha], 1)
    meta = {
        "version": 2,
        "count": len(g),
        "means": {"mins": mins.tolist(), "maxs": maxs.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": books["scales"].tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": ["sh0.webp"]},
    }
    files = {
        "means_l.webp": _webp(_plane(code & 255, width)),
        "means_u.webp": _webp(_plane(code >> 8, width)),
        "scales.webp": _webp(_plane(_nearest(g.log_scales, books["scales"]), width)),
        "quats.webp": _webp(packed),
        "sh0.webp": _webp(_plane(sh0, width)),
    }
    if g.sh_degree:
        higher = g.sh.shape[1] - 1
        entries = min(palette_entries, len(g))
        palette = np.zeros((-(-entries // 64) * 64, higher, 3), np.uint8)
        palette[:entries] = _nearest(g.sh[:entries, 1:], books["shN"])
        label = np.arange(len(g)) % entries
        meta["shN"] = {
            "count": entries,
            "bands": g.sh_degree,
            "codebook": books["shN"].tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
        files["shN_centroids.webp"] = _webp(palette.reshape(-1, 64 * higher, 3))
        labels = np.stack([label & 255, label >> 8, label * 0], 1)
        files["shN_labels.webp"] = _webp(_plane(labels, width))
    return {"meta.json": json.dumps(meta).encode(), **files}


def bytes_of(write: Callable[..., object], *content: object, name: str = "a") -> bytes:
    """Return what a writer of ours makes of something, in a file of that name."""
    with TemporaryDirectory() as folder:
        write(Path(folder) / name, *content)
        return (Path(folder) / name).read_bytes()


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk of a .glb."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def glb_column(content: dict[str, Any], binary: bytes, name: str) -> Array:
    """Return (N, k) an attribute of the first primitive, as glTF says it is stored."""
    about = content["accessors"][content["meshes"][0]["primitives"][0]["attributes"][name]]
    view, kind = content["bufferViews"][about["bufferView"]], {5123: "<u2", 5126: "<f4"}
    data = binary[view["byteOffset"] :][: view["byteLength"]]
    return np.frombuffer(data, kind[about["componentType"]]).reshape(about["count"], -1)


def glb(content: dict, binary: bytes) -> bytes:
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    header = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    return header + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary


def write_folder(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


def random_codec(kind: str, seed: int = 0) -> Codec:
    """Of vectors of 16 numbers, with latents of 3 where they blend."""
    rng = np.random.default_rng(seed)
    if kind == "codebook":
        vectors = unit(rng.normal(size=(11, 16))).astype(np.float32)
        return CodebookCodec(vectors, rng.uniform(size=(11, 3)).astype(np.float32))
    if kind == "linear":
        return LinearCodec(np.linalg.qr(rng.normal(size=(16, 3)))[0].T.astype(np.float32).copy())

    def layers(*widths: int) -> tuple[tuple[Array, Array], ...]:
        return tuple(
            (rng.normal(size=(out, into)).astype(np.float32), rng.normal(size=out).astype(np.float32))
            for into, out in pairwise(widths)
        )

    return AutoencoderCodec(layers(16, 8, 3), layers(3, 5, 8, 16))


def random_field(
    n: int, kind: str = "autoencoder", phrases: tuple[str, ...] = ("red mug", "Tür"), seed: int = 0
) -> LanguageField:
    rng = np.random.default_rng(seed)
    codec = random_codec(kind, seed=seed)
    if not codec.blends:
        latents = rng.integers(codec.size, size=(3, n, 1)).astype(np.uint16)
    else:
        latents = unit(rng.normal(size=(3, n, codec.latent_dim))).astype(np.float32)
    latents[:, ::7] = 0  # never observed
    big = codec.vector_dim
    others = unit(np.random.default_rng((seed, 1)).normal(size=(60, big)))
    return LanguageField(
        latents=latents,
        confidence=rng.uniform(0, 9, size=(3, n)).astype(np.float32),
        codec=codec,
        canonical=unit(rng.normal(size=(len(CANONICAL_PHRASES), big))).astype(np.float32),
        encoder_id="demo",
        phrasebook={phrase: unit(rng.normal(size=big)).astype(np.float32) for phrase in phrases},
        everyday=others.astype(np.float16).astype(np.float32),
    )


# Encoders of .splat and .spz: one Gaussian at a time.

HALF_TURN = np.diag([1.0, -1.0, -1.0])  # right down front <-> right up back


def _byte(value: float) -> int:
    return max(0, min(255, math.floor(value + 0.5)))


def _opacity(g: Gaussians, i: int) -> int:
    return _byte(255 / (1 + math.exp(-float(g.opacity_logits[i]))))


def _rgba(g: Gaussians, i: int) -> bytes:
    return bytes([*(_byte(255 * (0.5 + C0 * float(c))) for c in g.sh[i, 0]), _opacity(g, i)])


def _quaternion(g: Gaussians, i: int) -> Array:
    """w x y z of length 1."""
    return g.quats_wxyz[i].astype(float) / np.linalg.norm(g.quats_wxyz[i].astype(float))


def splat_bytes(g: Gaussians) -> bytes:
    out = b""
    for i in range(len(g)):
        out += struct.pack("<3f", *g.means[i]) + struct.pack("<3f", *np.exp(g.log_scales[i])) + _rgba(g, i)
        out += bytes(_byte(128 + 128 * q) for q in _quaternion(g, i))
    return out


def turned_coefficients(sh: Array, turn: Array) -> Array:
    """(N, K, 3) coefficients of the same colours after a `turn` (3, 3), by least squares over directions."""
    directions = unit(np.random.default_rng(0).normal(size=(400, 3)))
    count = sh.shape[1]
    matrix = np.linalg.lstsq(sh_basis(directions @ turn.T, count), sh_basis(directions, count), rcond=None)[0]
    return np.einsum("kj,njc->nkc", matrix, sh.astype(float))


def _smallest_three(xyzw: Array) -> bytes:
    largest = int(np.argmax(np.abs(xyzw)))
    xyzw = xyzw * (1 if xyzw[largest] > 0 else -1)
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | (xyzw[i] < 0) << 9 | min(511, round(abs(xyzw[i]) * 2**0.5 * 511))
    return struct.pack("<I", word)


def spz_blocks(g: Gaussians, version: int, turn: Array = HALF_TURN) -> list[bytes]:
    """The attributes in the order of the file, unzipped."""
    blocks: list[list[bytes]] = [[], [], [], [], [], []]
    sh = turned_coefficients(g.sh, turn)
    for i in range(len(g)):
        mean = turn @ g.means[i]
        if version == 1:
            blocks[0].append(struct.pack("<3e", *mean))
        else:
            codes = (round(float(x) * 2**12) for x in mean)
            blocks[0].append(b"".join(code.to_bytes(3, "little", signed=True) for code in codes))
        blocks[1].append(bytes([_opacity(g, i)]))
        blocks[2].append(bytes(_byte(255 * (0.5 + 0.15 * float(c))) for c in g.sh[i, 0]))
        blocks[3].append(bytes(_byte(16 * (float(s) + 10)) for s in g.log_scales[i]))
        w, x, y, z = _quaternion(g, i)
        x, y, z = np.linalg.det(turn) * turn @ [x, y, z]  # the axis of a rotation is a pseudovector
        if version < 3:
            sign = 1 if w >= 0 else -1
            blocks[4].append(bytes(_byte(127.5 + 127.5 * sign * float(q)) for q in (x, y, z)))
        else:
            blocks[4].append(_smallest_three(np.array([x, y, z, w])))
        blocks[5].append(bytes(_byte(128 + 128 * c) for c in sh[i, 1:].ravel()))
    return [b"".join(block) for block in blocks]


def spz_bytes(
    g: Gaussians, version: int = 3, *, flags: int = 0, records: bytes = b"", turn: Array = HALF_TURN
) -> bytes:
    """A whole file; `records` are extensions, which need the flag 2."""
    blocks = spz_blocks(g, version, turn)
    head = b"NGSP" + struct.pack("<IIBBB", version, len(g), g.sh_degree, 12, flags)
    if version < 4:
        return gzip.compress(head + b"\0" + b"".join(blocks) + records)
    blocks = [block for block in blocks if block]
    frames = [zstandard.ZstdCompressor(level=12).compress(block) for block in blocks]
    head += bytes([len(blocks)]) + struct.pack("<I12x", 32 + len(records)) + records
    sizes = [struct.pack("<QQ", len(frame), len(block)) for frame, block in zip(frames, blocks, strict=True)]
    return head + b"".join(sizes) + b"".join(frames)


# Checkpoints of other methods.


def geometry(g: Gaussians) -> list[Any]:
    """Elements 0 to 6 of a model: parameters on the CPU, as a checkpoint made there holds them."""
    arrays = (g.means, g.sh[:, :1], g.sh[:, 1:], g.log_scales, g.quats_wxyz, g.opacity_logits[:, None])
    return [3, *(nn.Parameter(torch.tensor(np.ascontiguousarray(array))) for array in arrays)]


def training_state(g: Gaussians) -> list[Any]:
    """What ends every tuple: radii, gradients and their counts, optimiser, extent (a NumPy number)."""
    n = len(g)
    xyz = nn.Parameter(torch.zeros(n, 3))
    optimiser = torch.optim.Adam([xyz], lr=0.0025, eps=1e-15)
    xyz.grad = torch.ones_like(xyz)
    optimiser.step()
    sums = [torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 1)]
    return [*sums, optimiser.state_dict(), np.float64(4.25)]


def save_model(path: Path, g: Gaussians, *between: Any, behind: tuple[Any, ...] = ()) -> Path:
    """(tuple, iteration) with `between` geometry and training state, and `behind` it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(((*geometry(g), *between, *training_state(g), *behind), 30_000), path)
    return path


def tensor(array: Array) -> nn.Parameter:
    return nn.Parameter(torch.from_numpy(np.array(array)), requires_grad=array.dtype.kind == "f")


class LangSplatAutoencoder(nn.Module):
    """The network whose `state_dict` is `best_ckpt.pth`."""

    def __init__(self, dim: int, encoder: tuple[int, ...], decoder: tuple[int, ...]) -> None:
        super().__init__()
        self.encoder = self._chain((dim, *encoder), normalised=True)
        self.decoder = self._chain((encoder[-1], *decoder, dim), normalised=False)

    @staticmethod
    def _chain(widths: tuple[int, ...], normalised: bool) -> nn.Sequential:
        layers: list[nn.Module] = []
        for into, out in pairwise(widths):
            between = [nn.BatchNorm1d(into), nn.ReLU()] if normalised else [nn.ReLU()]
            layers += [*(between if layers else []), nn.Linear(into, out)]
        return nn.Sequential(*layers)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        return nn.functional.normalize(self.encoder(x), dim=-1)

    def decode(self, x: torch.Tensor) -> torch.Tensor:
        return nn.functional.normalize(self.decoder(x), dim=-1)


def autoencoder(
    dim: int,
    encoder: tuple[int, ...] = (256, 128, 64, 32, 3),
    decoder: tuple[int, ...] = (16, 32, 64, 128, 256, 256),
) -> LangSplatAutoencoder:
    """In evaluation, with statistics and scales of batch normalisation that are not the initial ones."""
    torch.manual_seed(1)
    network = LangSplatAutoencoder(dim, encoder, decoder)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.uniform_(module.weight, 0.5, 2)
            nn.init.uniform_(module.bias, -0.3, 0.3)
    for _ in range(20):
        network.encoder(torch.randn(64, dim))
    return network.eval()


# Comparisons, bit for bit; and refusals.

TREE = ("leaves", "parents", "levels", "votes")
FIELDS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh")


def load_gaussians(path: Path) -> Gaussians:
    """Of a scene file, where they lie in the world."""
    return load_scene(path).world_gaussians()


def assert_same(got: Gaussians, want: Gaussians) -> None:
    """Bit for bit, NaN included."""
    for field in FIELDS:
        a, b = getattr(got, field), getattr(want, field)
        assert a.dtype == np.float32
        np.testing.assert_array_equal(a.view(np.uint32), b.view(np.uint32), field)


def assert_same_extras(got: Mapping[str, Array], want: Mapping[str, Array]) -> None:
    """Named arrays, in this order."""
    assert list(got) == list(want)
    for name, values in want.items():
        assert got[name].dtype == values.dtype
        np.testing.assert_array_equal(got[name], values, name)


def assert_same_tree(got: Tree, want: Tree) -> None:
    """Node by node."""
    assert_same_extras(_arrays(got, TREE), _arrays(want, TREE))


def assert_same_field(got: LanguageField, want: LanguageField) -> None:
    """Bit for bit: a saved scene must answer exactly like the one in memory."""
    for name in ("encoder_id", "temperature", "found", "calibration", "codec.kind"):
        assert attrgetter(name)(got) == attrgetter(name)(want)
    for part in (_parts, lambda field: field.codec.tensors(), lambda field: field.phrasebook):
        assert_same_extras(part(got), part(want))


def _parts(field: LanguageField) -> dict[str, Array]:
    found = _arrays(field, ("latents", "confidence", "canonical"))
    found |= {} if field.tree is None else _arrays(field.tree, TREE)
    found |= {} if field.everyday is None else {"everyday": field.everyday}
    for word in field.taught:
        found |= _arrays(word, ("vectors", "rivals"), f"{word.name} {word.level} ")
    return found


def _arrays(owner: object, names: Sequence[str], prefix: str = "") -> dict[str, Array]:
    return {prefix + name: getattr(owner, name) for name in names}


def same_or_a_line(
    read: Callable[[], T], check: Callable[[T], object], caplog: pytest.LogCaptureFixture
) -> int:
    """Read what was changed: the same by `check`, or an error, or said; return how many lines were said."""
    try:
        got = read()
    except InputError:
        return 0
    if not (lines := len(caplog.messages)):
        check(got)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(STRICTNESS, "on", True)
        with pytest.raises(InputError, match="--strict") if lines else nullcontext():
            read()
    return lines


def assert_refused(read: Callable[[Path], object], path: Path) -> None:
    """A FormatError of one short printable line that begins with the path and ends with a remedy."""
    with pytest.raises(FormatError) as caught:
        read(path)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert said.isprintable()
    assert "; " in said
    assert len(said) < len(str(path)) + 200  # whatever a library adds
