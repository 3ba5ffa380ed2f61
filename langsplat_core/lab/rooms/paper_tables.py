"""The paper's comparisons and ablations, on rooms whose truth is known (`langsplat bench paper`).

LERF's way, the paper's, the paper's without its autoencoder, and ours, with the same Gaussians, outlines and
encoder; the paper's latents of several lengths; one level against three; and what is left without masks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import LevelChoice, LiftConfig
from langsplat_core.errors import InputError
from langsplat_core.lab.config import BenchmarkConfig, PaperBenchConfig
from langsplat_core.lab.rooms.kept_rows import KeptRows
from langsplat_core.lab.rooms.patches import PatchField, judged, lift_patches, pictures, reread
from langsplat_core.lab.rooms.report import Measured, of_kind
from langsplat_core.lab.rooms.room import HOLD_OUT, Room, median_seconds, weights_digest
from langsplat_core.lab.rooms.scoring import ask
from langsplat_core.lab.rooms.variants import Variant, autoencoder, ceiling
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import load_encoder

PATCHES = "LERF's way: patches at seven scales, no masks"
OURS = "ours"
ALONE: tuple[LevelChoice, ...] = ("subpart", "part", "whole")
KINDS = ("object", "part", "subpart", "all")
_HEAD = ("way", *(f"{kind}: mIoU / loc / 3D %" for kind in KINDS), "ms from phrase to picture")


@dataclass(frozen=True)
class PaperRow:
    """One way in one room."""

    seed: int
    measured: Measured

    @property
    def picture_ms(self) -> float:
        """From a new phrase to one picture. The paper and LERF have no answer before the picture."""
        own = self.measured.query == "blend answers" and self.measured.name != PATCHES
        return self.measured.frame_ms + (self.measured.query_ms if own else 0.0)


def ways(config: PaperBenchConfig, dim: int) -> list[Variant]:
    """All of them but for LERF's. dim: numbers of the encoder's vectors."""
    ours = Variant(OURS, "truth")
    one_pass = LiftConfig(mode="one-pass")
    trained = LiftConfig(mode="gradient", steps=config.gradient_steps)
    paper = replace(ours, codec=autoencoder(steps=config.codec_steps), lift=one_pass, query="paper")
    made = [
        ours,
        replace(paper, name="the paper: autoencoder d = 3, trained", lift=trained),
        replace(paper, name=f"the paper without its autoencoder: {dim} numbers", codec=ceiling(dim)),
    ]
    made += [
        replace(paper, name=f"the paper in one pass, d = {d}", codec=autoencoder(d, config.codec_steps))
        for d in config.dims
    ]
    made += [replace(ours, name=f"ours, level {level} alone", level=level) for level in ALONE]
    made += [
        replace(ours, name="ours, masks of the weight-free segmenter", masks="graph"),
        replace(ours, name="ours, squares in place of masks", masks="tiles"),
    ]
    return made


def measure_paper(
    config: PaperBenchConfig,
    work: Path,
    progress: Progress = silent,
    rooms: BenchmarkConfig | None = None,
    kept: Path | None = None,
) -> list[PaperRow]:
    """Every way in every room.

    rooms: how they are photographed and trained; kept: a file that takes every row when it is made, and gives
    those that an earlier run has made. Raises InputError for settings without a row.
    """
    if not config.seeds:
        raise InputError("bench paper: name at least one of --seeds")
    encoder, weights = load_encoder("demo"), weights_digest("demo")
    variants = [Variant(PATCHES, "truth"), *ways(config, encoder.dim)]
    chosen = [v for v in variants if not config.only or any(text in v.name for text in config.only)]
    if not chosen:
        names = ", ".join(v.name for v in variants)
        raise InputError(f"--only {' '.join(config.only)}: no row has that; the rows are {names}")
    rows: list[PaperRow] = []
    for seed in config.seeds:
        room = Room(rooms or BenchmarkConfig(), config.tier, seed, work, (encoder, weights), progress)
        rows += [PaperRow(seed, measured) for measured in _of_room(room, chosen, config, kept)]
    return rows


def _of_room(
    room: Room, variants: Sequence[Variant], config: PaperBenchConfig, kept: Path | None
) -> Iterator[Measured]:
    matters = asdict(replace(config, seeds=(room.seed,), only=())) | {
        "rooms": asdict(room.config),
        "encoder": room.weights,
    }
    earlier = None if kept is None else KeptRows(kept, matters)
    for variant in variants:
        row = None if earlier is None else earlier.get(variant.masks, variant.name)
        if row is None:
            row = _by_patches(room, variant) if variant.name == PATCHES else room.measure(variant)
            if earlier is not None:
                earlier.add(row)
        yield row


def _by_patches(room: Room, variant: Variant) -> Measured:
    """The phrases, asked of vectors of patches. The encoder's words come through our own field's engine."""
    train, _ = room.capture.split(HOLD_OUT)
    views = [(room.capture.cameras[i], room.capture.images[i]) for i in train]
    vectors = lift_patches(load_lifting_rasterizer("cpu"), room.gaussians, views, room.encoder, room.progress)
    field, _, _ = room.field(replace(variant, name=OURS))
    patches = PatchField(vectors, field.canonical, field.reading.temperature)
    asked = ask(QueryEngine(Scene(room.gaussians, field), lambda _: room.encoder), room.texts)
    asked = replace(asked, answers=reread(asked.answers, patches))
    one = np.stack([answer.vector for answer in list(asked.answers.values())[:1]])

    def picture() -> Array:
        return pictures(patches, CpuRasterizer().view(room.gaussians, room.held_out[0]), one)

    measured = room.measure_asked(asked, variant, partial(judged, patches))
    return replace(
        measured,
        codec=f"{vectors.shape[2]} numbers at {len(vectors)} scales",
        bytes_per_gaussian=vectors.nbytes / max(vectors.shape[1], 1),
        frame_ms=1000 * median_seconds(picture),
    )


def paper_table(rows: Sequence[PaperRow]) -> str:
    """Markdown: means over rooms, with their standard deviation where there are several."""
    lines = ["| " + " | ".join(_HEAD) + " |", "|" + "---|" * len(_HEAD)]
    for name in dict.fromkeys(row.measured.name for row in rows):
        same = [row for row in rows if row.measured.name == name]
        cells = [_cell(np.array([of_kind(row.measured, kind)[1:] for row in same])) for kind in KINDS]
        lines.append(f"| {name} | {' | '.join(cells)} | {np.mean([row.picture_ms for row in same]):.0f} |")
    return "\n".join(lines) + "\n"


def _cell(shares: Array) -> str:
    """(rooms, 3) -> such as "83.8 / 96.0 / 81.6 +/- 5.4"; the spread is that of the first."""
    mean = " / ".join(f"{100 * share:.1f}" for share in shares.mean(axis=0))
    return mean if len(shares) < 2 else f"{mean} +/- {100 * shares[:, 0].std(ddof=1):.1f}"


def plot(rows: Sequence[PaperRow], path: Path) -> None:
    """Accuracy in pictures and among Gaussians against the time from a phrase to a picture; means over rooms,
    with bars of one standard deviation."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(10, 5.6), layout="constrained", sharex=True)
    names = list(dict.fromkeys(row.measured.name for row in rows))
    for panel, (title, column) in zip(panels, (("mIoU in pictures %", 1), ("IoU in 3D %", 3)), strict=True):
        for number, name in enumerate(names, 1):
            same = [row for row in rows if row.measured.name == name]
            shares = np.array([100 * of_kind(row.measured, "all")[column] for row in same])
            at = float(np.mean([row.picture_ms for row in same])), float(shares.mean())
            colour = "#0072b2" if name.startswith(OURS) else "#d55e00"
            # Ways that are equally fast stand above each other: their numbers go to both sides in turn.
            side = 1 if number % 2 else -1
            panel.errorbar(*at, yerr=shares.std(), fmt="o", color=colour, capsize=2)
            panel.annotate(
                str(number),
                at,
                fontsize=9,
                ha="left" if side > 0 else "right",
                va="center",
                xytext=(7 * side, 0),
                textcoords="offset points",
            )
        panel.set_xscale("log")
        panel.set_xlabel("milliseconds from a phrase to its picture")
        panel.set_ylabel(title)
        panel.grid(alpha=0.3)
    legend = [pyplot.Line2D([], [], linestyle="", label=f"{k}  {name}") for k, name in enumerate(names, 1)]
    figure.legend(
        handles=legend, loc="outside lower center", ncols=2, fontsize=8, handlelength=0, frameon=False
    )
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def figures(config: PaperBenchConfig, rooms: Sequence[PaperRow]) -> dict[str, Any]:
    """All figures."""
    return {"settings": asdict(config), "rows": [asdict(row) for row in rooms]}
