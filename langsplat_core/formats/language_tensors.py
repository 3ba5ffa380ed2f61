"""The tensors of a language sidecar, read and checked; the layout stands in `language`."""

import json
import struct
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import FormatError, printable_line, quoted
from langsplat_core.formats.packed_positions import step, unpack_positions
from langsplat_core.parsing.opening import open_for_reading, parse_json
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    LEVELS,
    Calibration,
    LanguageField,
    Odds,
    Reading,
    codec_from_tensors,
)
from langsplat_core.scene.codec import KINDS

FORMAT, VERSION = "langsplat", "2"
CODEC = "codec."
WAYS = len(fields(Calibration))  # to look for something, each with odds of its own
_KEYS = {
    "1": ("encoder", "levels", "codec", "d", "gaussians", "means_blake2b", "phrases"),
    "2": (
        *("encoder", "levels", "codec", "d", "gaussians", "means_blake2b", "phrases"),
        *("temperature", "found"),
    ),
}
_FLOATS = {"1": ("F32",), "2": ("F32", "F16")}
_WHOLE = {"codes": "U16", "things": "U16", "positions": "U64"}  # tensors that hold no floating-point numbers


@dataclass(frozen=True, eq=False)
class Stored:
    """What a sidecar holds."""

    field: LanguageField
    means: Array  # (N, 3) positions of the Gaussians it was made for, world units; NaN for those not finite
    precision: float  # of these positions, world units
    checksum: str  # of the means of the PLY


def read_stored(path: Path) -> Stored:
    """Everything in the sidecar `path`. Raises InputError when it cannot be opened and FormatError when it
    breaks a rule of the layout."""
    open_for_reading(path)[0].close()  # the same messages for a missing file as everywhere
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            _check_metadata(metadata, path)
            tensors = {}
            for name in file.keys():  # noqa: SIM118 (not a dictionary)
                kind = file.get_slice(name).get_dtype()
                wanted = (_WHOLE[name],) if name in _WHOLE else _FLOATS[metadata["version"]]
                if kind not in wanted:
                    raise FormatError(
                        f"{path}: tensor {quoted(name)} is {kind}; expected {' or '.join(wanted)}"
                    )
                tensor = file.get_tensor(name)
                tensors[name] = tensor if name in _WHOLE else tensor.astype(np.float32)
    except SafetensorError as error:
        raise FormatError(f"{path}: not a whole safetensors file ({printable_line(error, 80)})") from None
    return _assemble(tensors, metadata, path)


def _check_metadata(metadata: dict[str, str], path: Path) -> None:
    if metadata.get("format") != FORMAT:
        raise FormatError(f"{path}: a safetensors file, but not a language field of this program")
    version = metadata.get("version")
    if version not in _KEYS:
        raise FormatError(
            f"{path}: language format version {quoted(version)}; this program reads {' and '.join(_KEYS)}, "
            "update it"
        )
    for key in _KEYS[version]:
        if key not in metadata:
            raise FormatError(f"{path}: the header has no {key!r}")
    if metadata["levels"] != ",".join(LEVELS):
        raise FormatError(f"{path}: levels {quoted(metadata['levels'], 60)}; expected {','.join(LEVELS)!r}")


def _assemble(tensors: dict[str, Array], metadata: dict[str, str], path: Path) -> Stored:
    kind = KINDS.get(metadata["codec"])
    latents_name = "codes" if kind is not None and kind.space == "index" else "latents"
    places = ("means",) if metadata["version"] == "1" else ("positions", "corners")
    for name in (latents_name, "confidence", "canonical", *places):
        if name not in tensors:
            raise FormatError(f"{path}: tensor {name!r} is missing")
    for name, tensor in tensors.items():
        if name != "means" and not np.isfinite(tensor).all():
            raise FormatError(f"{path}: tensor {quoted(name)} holds numbers that are not finite")
    try:
        field = _field(tensors, metadata, latents_name, path)
        means, precision = _means(tensors, len(field))
    except (ValueError, TypeError, IndexError) as error:
        raise FormatError(f"{path}: {error}") from None
    if (metadata["d"], metadata["gaussians"]) != (str(field.codec.latent_dim), str(len(field))):
        raise FormatError(f"{path}: the header's d or number of Gaussians is not that of the tensors")
    if (field.confidence < 0).any():
        raise FormatError(f"{path}: tensor 'confidence' holds negative numbers")
    return Stored(field, means, precision, metadata["means_blake2b"])


def _field(
    tensors: dict[str, Array], metadata: dict[str, str], latents_name: str, path: Path
) -> LanguageField:
    weights = {name.removeprefix(CODEC): t for name, t in tensors.items() if name.startswith(CODEC)}
    codec = codec_from_tensors(metadata["codec"], weights)
    latents = tensors[latents_name]
    if latents_name == "codes":
        check_array("codes", latents, (len(LEVELS), "N"))
        latents = latents[..., None]
    phrases = _phrases(metadata, path)
    vectors = tensors.get("phrasebook", np.zeros((0, codec.vector_dim), np.float32))
    check_array("phrasebook", vectors, (len(phrases), codec.vector_dim))
    check_array("canonical", tensors["canonical"], (len(CANONICAL_PHRASES), codec.vector_dim))
    reading = Reading()
    if metadata["version"] != "1":
        calibration = _calibration(metadata, path)
        reading = Reading(float(metadata["temperature"]), float(metadata["found"]), calibration)
    return LanguageField(
        latents,
        tensors["confidence"],
        codec,
        tensors["canonical"],
        metadata["encoder"],
        dict(zip(phrases, vectors, strict=True)),
        reading,
        tensors.get("things"),
        tensors.get("everyday"),
    )


def _calibration(metadata: dict[str, str], path: Path) -> Calibration | None:
    if "odds" not in metadata:
        return None
    odds = parse_json(metadata["odds"].encode(), path)
    if not isinstance(odds, list) or len(odds) != WAYS or not all(map(_four, odds)):
        raise FormatError(f"{path}: the header's 'odds' are not {WAYS} lists of four numbers")
    return Calibration(*(Odds(*numbers) for numbers in odds))


def _four(numbers: object) -> bool:
    return isinstance(numbers, list) and len(numbers) == 4 and all(isinstance(n, float) for n in numbers)


def _means(tensors: dict[str, Array], count: int) -> tuple[Array, float]:
    """Positions of the Gaussians, and how precise they are."""
    if "means" in tensors:
        check_array("means", tensors["means"], (count, 3))
        return tensors["means"], 0.0
    check_array("positions", tensors["positions"], (count,))
    check_array("corners", tensors["corners"], (2, 3))
    corners = tensors["corners"]
    return unpack_positions(tensors["positions"], corners), step(corners)


def _phrases(metadata: dict[str, str], path: Path) -> list[str]:
    phrases = parse_json(metadata["phrases"].encode(), path)
    if not isinstance(phrases, list) or not all(isinstance(phrase, str) for phrase in phrases):
        raise FormatError(f"{path}: the header's 'phrases' are not a list of texts")
    if len(set(phrases)) != len(phrases):
        raise FormatError(f"{path}: the header's 'phrases' name one phrase twice")
    return phrases


def save_tensors(path: Path, tensors: dict[str, Array], metadata: dict[str, str]) -> None:
    """Write a safetensors file that is the same, byte for byte, whenever its content is.

    The library writes the metadata in an order of its own, another one each time; here they are sorted.
    """
    save_file({name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}, path, metadata)
    with open(path, "r+b") as file:
        (size,) = struct.unpack("<Q", file.read(8))
        header = json.loads(file.read(size))
        header["__metadata__"] = dict(sorted(metadata.items()))
        text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
        if len(text) <= size:  # always, unless the library begins to write JSON in another way
            file.seek(8)
            file.write(text.ljust(size))
