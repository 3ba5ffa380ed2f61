"""What small changes of the lifting gain, room by room (`langsplat bench gains`)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.config import CodebookConfig
from langsplat_core.errors import InputError
from langsplat_core.lab.config import BenchmarkConfig, GainBenchConfig, MaskOrigin
from langsplat_core.lab.rooms.gains import GAINS, Material
from langsplat_core.lab.rooms.kept_rows import KeptRows
from langsplat_core.lab.rooms.report import Measured, of_kind
from langsplat_core.lab.rooms.room import Room, weights_digest
from langsplat_core.lab.rooms.variants import Variant
from langsplat_core.progress import Progress, silent
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import CANONICAL_PHRASES, LanguageField
from langsplat_core.semantics.encoder import Encoder
from langsplat_core.semantics.encoders import load_encoder
from langsplat_core.training.language.codec_fit import Vocabulary, everyday_vocabulary, fit_codebook
from langsplat_core.training.language.lift import Lifted
from langsplat_core.training.language.mask_weights import find_mask_weights

SAMPLE = 36_000  # lifted vectors that a codebook is fitted to


@dataclass(frozen=True)
class Gain:
    """One change in one room with one origin of masks."""

    masks: MaskOrigin
    seed: int
    change: str
    measured: Measured

    @property
    def shares(self) -> tuple[float, ...]:
        """Mean IoU, localisation and 3-D IoU over all phrases."""
        return of_kind(self.measured, "all")[1:]


def measure_gains(
    config: GainBenchConfig,
    work: Path,
    progress: Progress = silent,
    rooms: BenchmarkConfig | None = None,
    kept: Path | None = None,
) -> list[Gain]:
    """Every change in every room; `rooms`: how they are photographed and trained; `kept`: a file that takes
    every row when it is made, and gives those that an earlier run has made. Raises InputError for settings
    without a room."""
    if not config.seeds or not config.masks:
        raise InputError("bench gains: name at least one of --seeds and one of --masks")
    encoder, rows = load_encoder("demo"), []
    vocabulary = everyday_vocabulary(encoder)
    settings = rooms or BenchmarkConfig()
    for seed in config.seeds:
        room = Room(settings, config.tier, seed, work, (encoder, weights_digest("demo")), progress)
        matters = asdict(replace(config, seeds=(seed,), masks=())) | {
            "rooms": asdict(settings),
            "encoder": room.weights,
        }
        earlier = None if kept is None else KeptRows(kept, matters)
        for masks in config.masks:
            material = cache(partial(_material, room, Variant("", masks)))  # not for rows that are there
            for change, lift in GAINS.items():
                measured = None if earlier is None else earlier.get(masks, change)
                if measured is None:
                    field = _field(lift(material()), encoder, vocabulary, config.size)
                    measured = room.measure_field(field, Variant(change, masks))
                    if earlier is not None:
                        earlier.add(measured)
                rows.append(Gain(masks, seed, change, measured))
    return rows


def _material(room: Room, variant: Variant) -> Material:
    views = room.views(variant)
    members = find_mask_weights(load_lifting_rasterizer(), room.gaussians, views, progress=room.progress)
    return Material(room.gaussians, members, tuple(features.vectors for _, features in views))


def _field(lifted: Lifted, encoder: Encoder, vocabulary: Vocabulary, size: int) -> LanguageField:
    seen = lifted.vectors[lifted.confidence > 0]
    sample = seen[np.random.default_rng(0).permutation(len(seen))[:SAMPLE]]
    codec = fit_codebook(sample, CodebookConfig(size=size), vocabulary)
    levels, count, dim = lifted.vectors.shape
    codes = codec.encode(lifted.vectors.reshape(-1, dim)).reshape(levels, count, 1)
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    return LanguageField(codes, lifted.confidence, codec, canonical, encoder.id, {}, encoder.reading)


def gain_table(rows: Sequence[Gain]) -> str:
    """Markdown: means over the rooms, and in how many of them a change gained, in percentage points."""
    head = ("masks", "change", "mIoU", "localisation", "3D IoU", "rooms with more mIoU")
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    unchanged = next(iter(GAINS))
    for masks in dict.fromkeys(row.masks for row in rows):
        base = _by_seed(rows, masks, unchanged)
        shares = np.mean(list(base.values()), axis=0)
        cells = [masks, unchanged, *(f"{100 * share:.1f}" for share in shares), ""]
        lines.append("| " + " | ".join(cells) + " |")
        for change in list(GAINS)[1:]:
            ours = _by_seed(rows, masks, change)
            differences = np.array([np.subtract(ours[seed], base[seed]) for seed in base])
            better = f"{int((differences[:, 0] > 0).sum())} of {len(base)}"
            cells = [masks, change, *(f"{100 * x:+.1f}" for x in differences.mean(0)), better]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def figures(config: GainBenchConfig, rows: Sequence[Gain]) -> dict[str, Any]:
    """All figures."""
    return {"settings": asdict(config), "rows": [asdict(row) for row in rows]}


def _by_seed(rows: Sequence[Gain], masks: MaskOrigin, change: str) -> dict[int, tuple[float, ...]]:
    return {row.seed: row.shares for row in rows if (row.masks, row.change) == (masks, change)}
