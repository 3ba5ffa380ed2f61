"""The sidecar: the language field of a scene, in `scene.langsplat.safetensors` beside `scene.ply`.

A safetensors file (an 8-byte length, a JSON header, raw little-endian tensors: nothing in it is ever
executed). Version 3, for N Gaussians, CLIP vectors of D numbers, P phrases and K nodes:

    tensor           type     shape      meaning
    codes            uint16   (3, N)     number of the codeword at subpart, part, whole: of a codebook
    latents          float    (3, N, d)  instead, of another codec; zero where never observed
    confidence       float    (3, N)     total blending weight of the observations, >= 0; 0 for no feature
    tree.leaves      uint16   (N,)       smallest node of a Gaussian, 65535 for none; uint32 and 4294967295
                                         if there are more nodes. Without a tree none is there
    tree.parents     uint32   (K,)       node that each is part of, a later one; 4294967295 for none
    tree.levels      uint8    (K,)       0, 1, 2: subpart, part, whole
    tree.votes       uint16   (K, 2)     photographs with a mask of exactly this node; those without one
    positions        uint64   (N,)       of the Gaussians that the field belongs to, see `pack_positions`
    corners          float32  (2, 3)     of the box of these positions
    canonical        float    (4, D)     unit text vectors of "object", "things", "stuff", "texture"
    everyday         float    (V, D)     unit text vectors of phrases most of which name nothing in the scene;
                                         absent if the encoder knows too few
    phrasebook       float    (P, D)     unit text vectors of `phrases`; absent if P = 0
    taught           float    (T, D)     examples of the taught words, one word after the other: unit vectors,
                                         see `scene.TaughtWord`; absent without taught words
    taught.rivals    float    (T,)       of each example, in [0, 1]
    codec.*          float               of a codebook vectors (K, D) and colours (K, 3); basis (d, D) of a
                                         linear codec; of an autoencoder
                                         {encoder,decoder}.{layer}.{weight,bias}

    metadata         value
    format           "langsplat"
    version          "3"
    encoder          hub id or folder of the text encoder
    levels           "subpart,part,whole"
    codec            "codebook", "autoencoder" or "linear"
    d                latent dimension, decimal
    gaussians        N, decimal
    means_blake2b    BLAKE2b-128 of the means of the scene, as float32 little endian, hexadecimal
    phrases          JSON list of the P phrases
    temperature      of the softmax over this encoder's cosines, decimal
    found            least relevancy of a phrase that is found, decimal
    odds             JSON: a list of numbers for each `PlattScaling` of `scene.Calibration`; absent without
                     one ("calibration" of older files is on another scale, and is not read)
    origin           JSON: three numbers, the origin of the positions, see `Scene`; absent for zero
    taught           JSON: for each taught word a list of its name, its level (0, 1, 2) and the number of its
                     examples; absent without taught words

A user's own words are a file of this kind too: `taught`, `taught.rivals` and `canonical`, with the metadata
format "langsplat words", version "1", encoder and taught.

"float" is float16 if that represents every number of the tensor exactly, else float32: a saved scene answers
exactly like the one in memory. The PLY is a plain file that other programs may edit; the checksum detects it,
and the positions let `rematch_language` carry the field over to an edited PLY.

Older versions are read too: version 2 has `things` in place of a tree, which are not read; in version 1
everything is float32, with `means` (N, 3) in place of positions and corners, no temperature and no found.
"""

import hashlib
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy
from msgspec import Meta
from numpy.typing import DTypeLike
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import expect, malformed, printable_line, quoted, report_losses, unread
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import FromFile, decode_json, open_for_reading
from langsplat_core.scene import LEVELS, NO_NODE, NO_ORIGIN, Calibration, LanguageField, TaughtWord, Tree
from langsplat_core.scene.codec import codec_from_tensors
from langsplat_core.scene.language import CANONICAL_PHRASES, MOST_SHOWN, PlattScaling

SUFFIX = ".langsplat.safetensors"
CODEC = "codec."
# Formats: name in the metadata; versions that are read, of which the last is written; name for messages
_Format = tuple[str, tuple[str, ...], str]
FIELD: _Format = ("langsplat", ("1", "2", "3"), "a language field")
WORDS: _Format = ("langsplat words", ("1",), "taught words")

_Odds = Annotated[list[float], Meta(min_length=4, max_length=5)]
_Count = Annotated[int, Meta(ge=1, le=MOST_SHOWN)]
_PARSED: Mapping[str, Any] = {  # metadata that are JSON
    "d": int,
    "gaussians": int,
    "phrases": list[str],
    "temperature": float,
    "found": float,
    "odds": Annotated[list[_Odds], Meta(min_length=3, max_length=5)],  # older: 3, of 4 numbers
    "origin": tuple[float, float, float],
    "taught": list[tuple[str, int, _Count]],
}
_KINDS = {  # types of tensors that hold no floating-point numbers
    "codes": ("U16",),
    "things": ("U16",),
    "positions": ("U64",),
    "tree.leaves": ("U16", "U32"),
    "tree.parents": ("U32",),
    "tree.levels": ("U8",),
    "tree.votes": ("U16",),
}
# Largest numbers of tensors; by default 10, as components of unit vectors are at most 1.
_MOST = {"confidence": 1e12, "latents": 1e3, "corners": math.inf}


@dataclass(frozen=True, eq=False)
class Stored:
    """Content of a sidecar."""

    field: LanguageField
    means: Array  # (N, 3) positions in the world of the Gaussians it belongs to; NaN if not finite
    precision: float  # of these positions, world units
    checksum: str  # of the means of the scene


def read_stored(path: Path) -> Stored:
    """Return the content of the sidecar `path`; InputError if it cannot be opened, else FormatError."""
    with _faults(path):
        tensors, about = _read(path, FIELD)
        if about["levels"] != ",".join(LEVELS):
            raise ValueError(f"levels {quoted(about['levels'])}; expected {','.join(LEVELS)!r}")
        if "means" in tensors:  # of version 1
            tensors["positions"], tensors["corners"] = pack_positions(tensors["means"])
        field = _field(tensors, about)
        if (about["d"], about["gaussians"]) != (field.codec.latent_dim, len(field)):
            raise ValueError("the header's d or number of Gaussians is not that of the tensors")
        if (field.confidence < 0).any():
            raise ValueError("tensor 'confidence' holds negative numbers")
        positions, corners = tensors["positions"], tensors["corners"]
        check_array("positions", positions, (len(field),))
        check_array("corners", corners, (2, 3))
        means, precision = unpack_positions(positions, corners)
        report_losses(path, _passed_over(field, tensors, about))
        return Stored(field, means + about.get("origin", 0.0), precision, about["means_blake2b"])


_ALWAYS = ("confidence", "positions", "corners", "means", "canonical", "everyday", "phrasebook")
_STATED = {*_PARSED, "format", "version", "encoder", "levels", "codec", "means_blake2b", "calibration"}


def _passed_over(field: LanguageField, tensors: dict[str, Array], about: dict[str, Any]) -> Iterator[str]:
    """Yield, for `report_losses`, parts of a field that are ignored or guessed."""
    read = {*_ALWAYS, "latents" if field.codec.blends else "codes"}
    read.update(CODEC + name for name in field.codec.tensors())
    read.update(name for name in _KINDS if name.startswith("tree.") and field.tree is not None)
    read.update(name for name in ("taught", "taught.rivals") if field.taught)
    yield unread("tensors", (quoted(name, 40) for name in tensors if name not in read))
    yield unread("metadata", (quoted(name, 40) for name in about if name not in _STATED))
    if "calibration" in about:
        yield "its calibration is of another scale, not read: `langsplat train --gaussians` makes one anew"
    absent = [name for name in ("temperature", "found") if name not in about and about["version"] != "1"]
    if absent:
        yield f"{' and '.join(absent)} not given: taken as of the encoder CLIP"


@contextmanager
def _faults(path: Path) -> Iterator[None]:
    """Turn errors of missing and unfitting tensors into FormatError."""
    try:
        yield
    except KeyError as missing:
        raise malformed(path, f"{missing} is missing") from None
    except SafetensorError as error:
        raise malformed(path, f"not a whole safetensors file ({printable_line(error, 80)})") from None
    except (ValueError, TypeError, IndexError) as error:
        raise malformed(path, str(error)) from None


def _read(path: Path, layout: _Format) -> tuple[dict[str, Array], dict[str, Any]]:
    """Return the tensors of a file of this layout, floats as float32, and its metadata."""
    open_for_reading(path)[0].close()  # the same messages for a missing file as everywhere
    stated, versions, what = layout
    tensors = {}
    with safe_open(path, framework="numpy") as file:
        about: dict[str, Any] = file.metadata() or {}
        if about.get("format") != stated:
            raise ValueError(f"a safetensors file, but not of {what}")
        if about.get("version") not in versions:
            other = f"version {quoted(about.get('version'))} of {what}"
            raise malformed(path, f"{other}; this program reads {' and '.join(versions)}", "update it")
        about |= {
            key: decode_json(about[key].encode(), kind, path) for key, kind in _PARSED.items() if key in about
        }
        for name in file.keys():  # noqa: SIM118 (not a dictionary)
            found, wanted = file.get_slice(name).get_dtype(), _KINDS.get(name, ("F32", "F16"))
            if found not in wanted:
                raise ValueError(f"tensor {quoted(name)} is {found}; expected {' or '.join(wanted)}")
            tensor = file.get_tensor(name)
            tensors[name] = tensor if name in _KINDS else _bounded(name, tensor.astype(np.float32))
    return tensors, about


def _bounded(name: str, tensor: Array) -> Array:
    """Return a tensor after a check that its numbers are finite and do not overflow in use; ValueError."""
    if name == "means":  # as they were in the PLY
        return tensor
    if not np.isfinite(tensor).all():
        raise ValueError(f"tensor {quoted(name)} holds numbers that are not finite")
    layers = name.startswith((f"{CODEC}encoder.", f"{CODEC}decoder."))  # bounded by the codec itself
    largest, most = np.abs(tensor).max(initial=0), math.inf if layers else _MOST.get(name, 10.0)
    if largest > most:
        raise ValueError(f"tensor {quoted(name)} holds {largest:g}; expected numbers up to {most:g}")
    return tensor


def _field(tensors: dict[str, Array], about: dict[str, Any]) -> LanguageField:
    codec = codec_from_tensors(
        about["codec"],
        {name.removeprefix(CODEC): t for name, t in tensors.items() if name.startswith(CODEC)},
    )
    phrases = about["phrases"]
    if len(set(phrases)) != len(phrases):
        raise ValueError("the header's 'phrases' name one phrase twice")
    vectors = tensors.get("phrasebook", np.zeros((0, codec.vector_dim), np.float32))
    check_array("phrasebook", vectors, (len(phrases), codec.vector_dim))
    check_array("canonical", tensors["canonical"], (len(CANONICAL_PHRASES), codec.vector_dim))
    odds = about.get("odds")
    known = {key: about[key] for key in ("temperature", "found") if key in about}
    tree = None
    if "tree.leaves" in tensors:
        leaves, parents = _signed(tensors["tree.leaves"]), _signed(tensors["tree.parents"])
        tree = Tree(leaves, parents, tensors["tree.levels"], tensors["tree.votes"])
    return LanguageField(
        tensors["latents"] if codec.blends else tensors["codes"][..., None],
        tensors["confidence"],
        codec,
        tensors["canonical"],
        FromFile(about["encoder"]),
        dict(zip(phrases, vectors, strict=True)),
        **known,
        calibration=odds and Calibration(*(PlattScaling(*numbers) for numbers in odds)),
        tree=tree,
        everyday=tensors.get("everyday"),
        taught=_taught(tensors, about),
    )


def _taught(tensors: dict[str, Array], about: dict[str, Any]) -> tuple[TaughtWord, ...]:
    if not (stated := about.get("taught", [])):
        return ()
    vectors, rivals = tensors["taught"], tensors["taught.rivals"]
    check_array("taught", vectors, (sum(count for *_, count in stated), "D"))
    check_array("taught.rivals", rivals, (len(vectors),))
    ends = np.cumsum([count for *_, count in stated])[:-1]
    every = zip(stated, np.split(vectors, ends), np.split(rivals, ends), strict=True)
    return tuple(TaughtWord(name, level, *examples) for (name, level, _), *examples in every)


def _taught_parts(words: Sequence[TaughtWord]) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the tensors and metadata of taught words; both empty without words."""
    if not words:
        return {}, {}
    stated = [[word.name, word.level, len(word.vectors)] for word in words]
    vectors, rivals = (np.concatenate([getattr(w, part) for w in words]) for part in ("vectors", "rivals"))
    texts = {"taught": json.dumps(stated, ensure_ascii=False)}
    return {"taught": _narrow(vectors), "taught.rivals": _narrow(rivals)}, texts


def _signed(numbers: Array) -> Array:
    """Return numbers as int32, with NO_NODE for the largest of their type."""
    none = np.iinfo(numbers.dtype).max
    return np.where(numbers == none, NO_NODE, numbers.astype(np.int64)).astype(np.int32)


def _unsigned(numbers: Array, kind: DTypeLike) -> Array:
    return np.where(numbers == NO_NODE, np.iinfo(kind).max, numbers).astype(kind)


def _save(path: Path | str, layout: _Format, tensors: dict[str, Array], about: dict[str, str]) -> None:
    """Write a safetensors file, atomically; equal content gives equal bytes.

    The library writes the metadata in random order, so they are sorted here.
    """
    name, versions, _ = layout
    about = {"format": name, "version": versions[-1], **about}
    with atomic_path(path) as temporary:
        tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
        save_file(tensors, temporary, about)
        with open(temporary, "r+b") as file:
            (size,) = struct.unpack("<Q", file.read(8))
            header = json.loads(file.read(size)) | {"__metadata__": dict(sorted(about.items()))}
            text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
            if len(text) <= size:  # unless a later library formats JSON differently
                file.seek(8)
                file.write(text.ljust(size))


def means_checksum(means: Array) -> str:
    """Return the BLAKE2b-128 of (N, 3) float32 positions, which changes with any edit and reordering."""
    return hashlib.blake2b(np.ascontiguousarray(means, dtype="<f4").tobytes(), digest_size=16).hexdigest()


def write_language(path: Path | str, field: LanguageField, means: Array, origin: Array = NO_ORIGIN) -> None:
    """Write `field` for the Gaussians at `means` (N, 3) of a scene with an `origin` (3,), atomically."""
    check_array("means", means, (len(field), 3), dtype=np.float32)
    positions, corners = pack_positions(means)
    floats = {
        "confidence": field.confidence,
        "canonical": field.canonical,
        **({"latents": field.latents} if field.codec.blends else {"codes": field.latents[..., 0]}),
        **({} if field.everyday is None else {"everyday": field.everyday}),
        **({"phrasebook": np.stack(list(field.phrasebook.values()))} if field.phrasebook else {}),
        **{CODEC + name: tensor for name, tensor in field.codec.tensors().items()},
    }
    taught, stated = _taught_parts(field.taught)
    tensors = {name: _narrow(tensor) for name, tensor in floats.items()} | taught
    tensors |= {"positions": positions, "corners": corners}
    if (tree := field.tree) is not None:
        few = tree.count < np.iinfo(np.uint16).max
        tensors |= {
            "tree.leaves": _unsigned(tree.leaves, np.uint16 if few else np.uint32),
            "tree.parents": _unsigned(tree.parents, np.uint32),
            "tree.levels": tree.levels,
            "tree.votes": tree.votes,
        }
    about = {
        "encoder": field.encoder_id,
        "levels": ",".join(LEVELS),
        "codec": field.codec.kind,
        "d": str(field.codec.latent_dim),
        "gaussians": str(len(field)),
        "means_blake2b": means_checksum(means),
        "phrases": json.dumps(list(field.phrasebook), ensure_ascii=False),
        "temperature": repr(field.temperature),
        "found": repr(field.found),
        **stated,
    }
    if origin.any():
        about["origin"] = json.dumps(origin.tolist())
    if field.calibration is not None:
        about["odds"] = json.dumps(astuple(field.calibration), default=float)
    _save(path, FIELD, tensors, about)


@dataclass(frozen=True, eq=False)
class Words:
    """Taught words of one encoder."""

    encoder_id: str
    canonical: Array  # (4, D) float32 unit text vectors of its canonical phrases, which identify it
    words: tuple[TaughtWord, ...]
    path: Path | None = None  # the file that they were read from


def write_words(path: Path | str, words: Words) -> None:
    """Write taught words as a user's file, atomically."""
    expect(words, Words, "say write_words(path, words)")
    taught, stated = _taught_parts(words.words)
    _save(path, WORDS, {"canonical": words.canonical, **taught}, {"encoder": words.encoder_id, **stated})


def read_words(path: Path | str) -> Words:
    """Return the taught words in a file of `write_words`. Raises as `read_stored` does."""
    expect(path, str | os.PathLike, "name a file that write_words wrote")
    path = Path(path)
    with _faults(path):
        tensors, about = _read(path, WORDS)
        words = _taught(tensors, about)
        dims = check_array("canonical", tensors["canonical"], (len(CANONICAL_PHRASES), "D"))
        for word in words:
            check_array("taught", word.vectors, ("T", "D"), dims)
        if len({word.key for word in words}) != len(words):
            raise ValueError("two taught words have one name")
        return Words(about["encoder"], tensors["canonical"], words, path)


def _narrow(tensor: Array) -> Array:
    if tensor.dtype != np.float32:
        return tensor
    with np.errstate(over="ignore"):
        half = tensor.astype(np.float16)
    return half if np.array_equal(half.astype(np.float32), tensor) else tensor


def read_language(path: Path | str, means: Array, origin: Array = NO_ORIGIN) -> LanguageField:
    """Return the field in the sidecar `path`, which must belong to the Gaussians at `means` (N, 3) float32.

    origin: (3,), of their scene; sidecars from before origins existed have the checksum of positions in the
    world. FormatError if it breaks a rule of the layout or belongs to other Gaussians.
    """
    path = Path(path)
    stored = read_stored(path)
    mend = f"if the PLY was edited, run 'langsplat convert EDITED.ply NEW.ply --rematch {path}'"
    if len(stored.field) != len(means):
        raise malformed(path, f"made for {len(stored.field)} Gaussians, the scene has {len(means)}", mend)
    if stored.checksum not in (means_checksum(means), means_checksum(means.astype(np.float64) + origin)):
        raise malformed(path, "made for Gaussians at other positions than the scene's", mend)
    return stored.field


def rematch_language(sidecar: Path | str, new_means: Array) -> LanguageField:
    """Return the field in `sidecar`, carried over to Gaussians at `new_means` (N, 3) by nearest position.

    new_means: in the world, float64 far from zero. A match is at most as far as the median distance of an old
    Gaussian to its nearest neighbour: rounding is allowed, but what was added or moved far gets no feature.
    """
    stored = read_stored(Path(sidecar))
    old_rows = np.flatnonzero(np.isfinite(stored.means).all(1))
    match = np.full(len(new_means), -1)
    if len(old_rows):
        points = scipy.spatial.cKDTree(stored.means[old_rows])
        spacing = points.query(points.data[:: max(1, len(old_rows) // 10_000)], k=2)[0][:, 1]
        spacing[~np.isfinite(spacing)] = 0  # there is only one
        new_rows = np.flatnonzero(np.isfinite(new_means).all(1))
        distance, nearest = points.query(new_means[new_rows])
        found = distance <= np.median(spacing) + stored.precision
        match[new_rows[found]] = old_rows[nearest[found]]
    return stored.field.matched(match)


# ---- positions in 8 bytes: 21 bits per axis, between the corners of their box ----
#
# They identify Gaussians after a PLY was edited. A 2 millionth of the box is precise enough, even if a few
# floaters make the box a thousand times larger than the scene.

_SHIFTS = np.array([0, 21, 42], np.uint64)
_STEPS = 2**21 - 1
_NOWHERE = np.uint64(2**64 - 1)  # for a position that is not finite


def pack_positions(means: Array) -> tuple[Array, Array]:
    """Return (N, 3) float32 positions as (N,) uint64, and the (2, 3) float32 corners of finite ones."""
    finite = np.isfinite(means).all(1)
    packed = np.full(len(means), _NOWHERE)
    if not finite.any():
        return packed, np.zeros((2, 3), np.float32)
    corners = np.stack([means[finite].min(0), means[finite].max(0)]).astype(np.float32)
    low, span = _box(corners)
    steps = np.rint((means[finite].astype(np.float64) - low) / span * _STEPS).astype(np.uint64)
    packed[finite] = np.bitwise_or.reduce(steps << _SHIFTS, axis=1)
    return packed, corners


def unpack_positions(packed: Array, corners: Array) -> tuple[Array, float]:
    """Return (N, 3) float64 positions, exact to half a step, NaN if not finite, and the longest step."""
    low, span = _box(corners)
    means = (packed[:, None] >> _SHIFTS & np.uint64(_STEPS)).astype(np.float64) / _STEPS * span + low
    means[packed == _NOWHERE] = np.nan
    return means, float(span.max() / _STEPS)


def _box(corners: Array) -> tuple[Array, Array]:
    """Return lower corner and extent, float64; the extent of a flat axis is 1."""
    low, high = corners.astype(np.float64)
    return low, np.where(high > low, high - low, 1.0)
