"""The language field of a scene: `scene.langsplat.safetensors` beside `scene.ply`.

A safetensors file (an 8-byte length, a JSON header, raw little-endian tensors: nothing in it is ever
executed). Version 1, for N Gaussians, latents of d numbers, CLIP vectors of D numbers and P phrases:

    tensor           type     shape      meaning
    latents          float32  (3, N, d)  of subpart, part, whole; zero where never observed
    confidence       float32  (3, N)     total blending weight of the observations, >= 0
    means            float32  (N, 3)     positions of the Gaussians that the field belongs to
    canonical        float32  (4, D)     unit text vectors of "object", "things", "stuff", "texture"
    phrasebook       float32  (P, D)     unit text vectors of `phrases`; absent when P = 0
    codec.*          float32             weights: codec.basis (d, D) of a linear codec; of an autoencoder
                                         codec.{encoder,decoder}.{layer}.{weight,bias}

    metadata         value
    format           "langsplat"
    version          "1"
    encoder          hub id or folder of the text encoder
    levels           "subpart,part,whole"
    codec            "autoencoder" or "linear"
    d                latent dimension, decimal
    gaussians        N, decimal
    means_blake2b    BLAKE2b-128 of the means of the PLY, as float32 little endian, hexadecimal
    phrases          JSON list of the P phrases

The PLY stays a plain file that other programs edit; the checksum notices it. The means are stored so that
`rematch_language` can carry the field over to an edited PLY. Everything is float32, 24 + 12 d bytes per
Gaussian beside 248 in the PLY: a saved scene answers exactly like the one in memory. (Float16 latents
would save 6 d of them and tilt a unit latent by up to 0.02 degrees.)
"""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from langsplat_core.arrays import Array, check_array
from langsplat_core.errors import FormatError
from langsplat_core.files import atomic_path
from langsplat_core.formats.opening import open_for_reading, parse_json
from langsplat_core.scene import LEVELS, LanguageField, codec_from_tensors

FORMAT, VERSION = "langsplat", "1"
SUFFIX = ".langsplat.safetensors"
_CODEC = "codec."


def means_checksum(means: Array) -> str:
    """Of (N, 3) float32 positions; every bit counts, so that any edit or reordering is noticed."""
    data = np.ascontiguousarray(means, dtype="<f4")
    return hashlib.blake2b(data.tobytes(), digest_size=16).hexdigest()


def write_language(path: Path | str, field: LanguageField, means: Array) -> None:
    """Write `field` for the Gaussians at `means` (N, 3), atomically."""
    check_array("means", means, (len(field), 3), dtype=np.float32)
    tensors = {
        "latents": field.latents,
        "confidence": field.confidence,
        "means": means,
        "canonical": field.canonical,
        **{_CODEC + name: tensor for name, tensor in field.codec.tensors().items()},
    }
    if field.phrasebook:
        tensors["phrasebook"] = np.stack(list(field.phrasebook.values()))
    metadata = {
        "format": FORMAT,
        "version": VERSION,
        "encoder": field.encoder_id,
        "levels": ",".join(LEVELS),
        "codec": field.codec.kind,
        "d": str(field.codec.latent_dim),
        "gaussians": str(len(field)),
        "means_blake2b": means_checksum(means),
        "phrases": json.dumps(list(field.phrasebook), ensure_ascii=False),
    }
    with atomic_path(path) as temporary:
        save_file({name: np.ascontiguousarray(t) for name, t in tensors.items()}, temporary, metadata)


def read_language(path: Path | str, means: Array) -> LanguageField:
    """The field in the sidecar `path`, which must belong to the Gaussians at `means` (N, 3) float32.

    Raises InputError when it cannot be opened and FormatError when it breaks a rule of the layout or was
    made for other Gaussians.
    """
    path = Path(path)
    field, made_for, checksum = _read(path)
    mend = f"; if the PLY was edited, run 'langsplat convert EDITED.ply NEW.ply --rematch {path}'"
    if len(made_for) != len(means):
        raise FormatError(f"{path}: made for {len(made_for)} Gaussians, the scene has {len(means)}{mend}")
    if checksum != means_checksum(means):
        raise FormatError(f"{path}: made for Gaussians at other positions than the scene's{mend}")
    return field


def rematch_language(
    sidecar: Path | str, new_means: Array, max_distance: float | None = None
) -> LanguageField:
    """The field in `sidecar`, carried over to Gaussians at `new_means` (N, 3) by nearest position.

    `max_distance` is in world units; by default the median distance of the old Gaussians to their nearest
    neighbours, so that positions may have been rounded (a compressed PLY does) but what was added or
    moved far gets no meaning. A Gaussian without a partner has confidence 0 and zero latents.
    """
    from scipy.spatial import cKDTree  # 0.2 s to import, and only this function needs it

    field, old_means, _ = _read(Path(sidecar))
    old_rows = np.flatnonzero(np.isfinite(old_means).all(1))
    new_rows = np.flatnonzero(np.isfinite(new_means).all(1))
    latents = np.zeros((len(LEVELS), len(new_means), field.latents.shape[2]), np.float32)
    confidence = np.zeros((len(LEVELS), len(new_means)), np.float32)
    if len(old_rows) and len(new_rows):
        tree = cKDTree(old_means[old_rows])
        if max_distance is None:
            max_distance = _median_spacing(tree)
        distance, partner = tree.query(new_means[new_rows])
        found = distance <= max_distance
        to, source = new_rows[found], old_rows[partner[found]]
        latents[:, to], confidence[:, to] = field.latents[:, source], field.confidence[:, source]
    return LanguageField(
        latents, confidence, field.codec, field.canonical, field.encoder_id, field.phrasebook
    )


def _median_spacing(tree: Any) -> float:
    """Median distance of (a sample of) the tree's points to their nearest neighbours; 0 for a single one."""
    sample = tree.data[:: max(1, len(tree.data) // 10_000)]
    distances = tree.query(sample, k=2)[0][:, 1]  # infinite where there is no second point
    return float(np.median(np.where(np.isfinite(distances), distances, 0)))


def _read(path: Path) -> tuple[LanguageField, Array, str]:
    """The field, the (N, 3) means it was made for and the checksum of the PLY's."""
    open_for_reading(path)[0].close()  # the same messages for a missing file as everywhere
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            _check_metadata(metadata, path)
            tensors = {}
            for name in file.keys():  # noqa: SIM118 (not a dictionary)
                kind = file.get_slice(name).get_dtype()
                if kind != "F32":
                    raise FormatError(f"{path}: tensor {name!r} is {kind}; expected F32")
                tensors[name] = file.get_tensor(name)
    except SafetensorError as error:
        raise FormatError(f"{path}: not a whole safetensors file ({error})") from None
    return _assemble(tensors, metadata, path)


def _check_metadata(metadata: dict[str, str], path: Path) -> None:
    if metadata.get("format") != FORMAT:
        raise FormatError(f"{path}: a safetensors file, but not a language field of this program")
    if metadata.get("version") != VERSION:
        raise FormatError(
            f"{path}: language format version {metadata.get('version')!r}; this program reads {VERSION!r}, "
            "update it"
        )
    for key in ("encoder", "levels", "codec", "d", "gaussians", "means_blake2b", "phrases"):
        if key not in metadata:
            raise FormatError(f"{path}: the header has no {key!r}")
    if metadata["levels"] != ",".join(LEVELS):
        raise FormatError(f"{path}: levels {metadata['levels'][:60]!r}; expected {','.join(LEVELS)!r}")


def _assemble(
    tensors: dict[str, Array], metadata: dict[str, str], path: Path
) -> tuple[LanguageField, Array, str]:
    for name in ("latents", "confidence", "means", "canonical"):
        if name not in tensors:
            raise FormatError(f"{path}: tensor {name!r} is missing")
    means, phrases = tensors["means"], _phrases(metadata, path)
    weights = {name.removeprefix(_CODEC): t for name, t in tensors.items() if name.startswith(_CODEC)}
    try:
        codec = codec_from_tensors(metadata["codec"], weights)
        dims = check_array("means", means, ("N", 3))
        dims = check_array("latents", tensors["latents"], (len(LEVELS), "N", codec.latent_dim), dims)
        vectors = tensors.get("phrasebook", np.zeros((0, codec.vector_dim), np.float32))
        check_array("phrasebook", vectors, (len(phrases), codec.vector_dim))
        field = LanguageField(
            tensors["latents"],
            tensors["confidence"],
            codec,
            tensors["canonical"],
            metadata["encoder"],
            dict(zip(phrases, vectors, strict=True)),
        )
    except (ValueError, TypeError, IndexError) as error:
        raise FormatError(f"{path}: {error}") from None
    if (metadata["d"], metadata["gaussians"]) != (str(codec.latent_dim), str(len(field))):
        raise FormatError(f"{path}: the header's d or number of Gaussians is not that of the tensors")
    for name, tensor in tensors.items():
        if name != "means" and not np.isfinite(tensor).all():
            raise FormatError(f"{path}: tensor {name!r} holds numbers that are not finite")
    if (field.confidence < 0).any():
        raise FormatError(f"{path}: tensor 'confidence' holds negative numbers")
    return field, means, metadata["means_blake2b"]


def _phrases(metadata: dict[str, str], path: Path) -> list[str]:
    phrases = parse_json(metadata["phrases"].encode(), path)
    if not isinstance(phrases, list) or not all(isinstance(phrase, str) for phrase in phrases):
        raise FormatError(f"{path}: the header's 'phrases' are not a list of texts")
    if len(set(phrases)) != len(phrases):
        raise FormatError(f"{path}: the header's 'phrases' name one phrase twice")
    return phrases
