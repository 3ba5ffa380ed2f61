"""The report `lifting`: methods from masks to answers side by side, in rooms with known truth.

LERF's method, the paper's with and without its autoencoder, its training from both starts, lifted CLIP
vectors behind every codec, and ours with one part taken out, all with the same Gaussians, outlines and
encoder.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.config import CodebookConfig, Count, LevelChoice, LiftConfig, LinearConfig
from langsplat_core.errors import InputError
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.scene import Scene
from tests.benchmarks.files import KeptRows, publish
from tests.benchmarks.patches import PatchField, judged, lift_patches, pictures, reread
from tests.benchmarks.room import (
    HOLD_OUT,
    InRooms,
    MaskOrigin,
    Room,
    Variant,
    autoencoder,
    ceiling,
    median_seconds,
)
from tests.benchmarks.scoring import Measured, ask, loss_cells, of_kind

PATCHES = "LERF's method: patches at seven scales, no masks"
OURS = "ours"
ALONE: tuple[LevelChoice, ...] = ("subpart", "part", "whole")
KINDS = ("object", "part", "subpart", "all")


@dataclass(frozen=True)
class Lifting(InRooms):
    """LERF's method, the paper's with and without its autoencoder, every codec and ours, in rooms with known
    truth: accuracy in images and among Gaussians, relevancy error, bytes, seconds. Hours; every row is kept
    as it is made."""

    masks: tuple[MaskOrigin, ...] = ("truth",)
    """Exact outlines, the same with every seventh vector another region's, the weight-free segmenter's."""
    codec_steps: Count = 4_000
    """Training steps of the autoencoders."""
    gradient_steps: Count = 3_000
    """Steps of the paper's training; it takes 30 000."""
    only: tuple[str, ...] = ()
    """Methods whose name holds one of these texts; all of them if empty."""

    def run(self) -> None:
        with TerminalProgress() as progress:
            kept = KeptRows(self.out / "lifting.rows.jsonl")
            rows = [row for room in self.rooms(progress) for row in measure_methods(room, self, kept)]
        first = [row for row in rows if row.measured.masks in (self.masks[0], "tiles")]
        publish(self, "lifting", "From masks to answers", method_table(rows), rows, partial(plot, first))


@dataclass(frozen=True)
class MethodRow:
    """One method in one room."""

    seed: int
    measured: Measured

    @property
    def image_ms(self) -> float:
        """Milliseconds from a new phrase to one image. The paper and LERF have no answer before the image."""
        own = self.measured.query == "blend answers" and self.measured.name != PATCHES
        return self.measured.frame_ms + (self.measured.query_ms if own else 0.0)


def methods(command: Lifting, masks: MaskOrigin, dim: int) -> list[Variant]:
    """All methods. dim: numbers of the encoder's vectors."""
    ours = Variant(OURS, masks)
    one_pass, latent = LiftConfig(mode="one-pass"), autoencoder(steps=command.codec_steps)
    trained = LiftConfig(mode="gradient", steps=command.gradient_steps)
    from_zeros = replace(trained, start="zeros-as-published")
    paper = replace(ours, codec=latent, lift=one_pass, query="paper")
    made = [
        ours,
        replace(paper, name="the paper: autoencoder d = 3, trained", lift=trained),
        replace(paper, name="the paper, trained from zeros", lift=from_zeros),
        replace(paper, name=f"the paper without its autoencoder: {dim} numbers", codec=ceiling(dim)),
    ]
    made += [
        replace(paper, name=f"the paper in one pass, d = {d}", codec=autoencoder(d, command.codec_steps))
        for d in (1, 2, 3, 8)
    ]
    made += [
        replace(paper, name="one-pass latents, answers blended", query="blend answers"),
        replace(ours, name="ours, mean and autoencoder d = 3", codec=latent, lift=LiftConfig(mode="mean")),
        replace(ours, name="ours, autoencoder d = 3", codec=latent),
        replace(ours, name="ours, 64 linear numbers", codec=LinearConfig(latent_dim=64)),
    ]
    made += [
        replace(ours, name=f"ours, codebook of {size}", codec=CodebookConfig(size=size))
        for size in (256, 1_024, 4_096)
    ]
    made.append(replace(ours, name=f"ours, all {dim} numbers", codec=ceiling(dim)))
    made += [replace(ours, name=f"ours, level {level} alone", level=level) for level in ALONE]
    if masks == "truth":
        made.append(replace(ours, name="ours, masks of the weight-free segmenter", masks="graph"))
        made.append(replace(ours, name="ours, squares in place of masks", masks="tiles"))
    return [*made, Variant(PATCHES, masks)]


def measure_methods(room: Room, command: Lifting, kept: KeptRows) -> Iterator[MethodRow]:
    """Every chosen method in one room. Seconds of a fit are of everything in it, with nothing taken from an
    earlier run. Raises InputError where --only names none."""
    every = [variant for masks in command.masks for variant in methods(command, masks, room.encoder.dim)]
    chosen = [v for v in every if not command.only or any(text in v.name for text in command.only)]
    if not chosen:
        names = ", ".join(dict.fromkeys(v.name for v in every))
        raise InputError(f"--only {' '.join(command.only)}: no method has that; they are {names}")
    config = room.config
    size = {"views": config.views, "size": config.size, "steps": config.steps, "most": config.max_gaussians}
    steps = {"codec_steps": command.codec_steps, "gradient_steps": command.gradient_steps}
    base = {"room": f"{room.tier} {room.seed}", **size, "encoder": room.weights, "cut": config.cut, **steps}
    for variant in chosen:
        made = by_patches if variant.name == PATCHES else partial(Room.measure, fresh=True)
        key = base | {"masks": variant.masks, "method": variant.name}
        yield MethodRow(room.seed, kept.row(key, partial(made, room, variant)))


def by_patches(room: Room, variant: Variant) -> Measured:
    """Ask the phrases of vectors of patches; they are encoded by our own field's engine."""
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


def method_table(rows: Sequence[MethodRow]) -> str:
    """Markdown: means over rooms, with the standard deviation of mIoU where there are several."""
    lines = []
    for masks, name in dict.fromkeys((row.measured.masks, row.measured.name) for row in rows):
        same = [row for row in rows if (row.measured.masks, row.measured.name) == (masks, name)]
        cells = [_cell(np.array([of_kind(row.measured, kind)[1:] for row in same])) for kind in KINDS]
        seconds = np.mean([row.measured.fit_seconds for row in same])
        times = (
            "-" if np.isnan(seconds) else f"{seconds:.0f}",
            f"{np.mean([row.image_ms for row in same]):.0f}",
        )
        lines.append((masks, name, *cells, *loss_cells([row.measured for row in same]), *times))
    shares = (f"{kind}: mIoU / loc / 3D %" for kind in KINDS)
    codec = ("codec", "relevancy error mean / p99", "bytes/Gaussian", "s to fit", "ms from phrase to image")
    return markdown(("masks", "method", *shares, *codec), lines)


def _cell(shares: Array) -> str:
    """(rooms, 3) -> such as "83.8 / 96.0 / 81.6 +/- 5.4"; the spread is that of the first."""
    mean = " / ".join(f"{100 * share:.1f}" for share in shares.mean(axis=0))
    return mean if len(shares) < 2 else f"{mean} +/- {100 * shares[:, 0].std(ddof=1):.1f}"


def plot(rows: Sequence[MethodRow], path: Path) -> None:
    """Accuracy in images and among Gaussians against the time from a phrase to an image; means over rooms,
    with bars of one standard deviation."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(10, 5.6), layout="constrained", sharex=True)
    names = list(dict.fromkeys(row.measured.name for row in rows))
    for panel, (title, column) in zip(panels, (("mIoU in images %", 1), ("IoU in 3D %", 3)), strict=True):
        for number, name in enumerate(names, 1):
            same = [row for row in rows if row.measured.name == name]
            shares = np.array([100 * of_kind(row.measured, "all")[column] for row in same])
            at = float(np.mean([row.image_ms for row in same])), float(shares.mean())
            colour = "#0072b2" if name.startswith(OURS) else "#d55e00"
            # Methods that are equally fast stand above each other: their numbers go to both sides in turn.
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
        panel.set_xlabel("milliseconds from a phrase to its image")
        panel.set_ylabel(title)
        panel.grid(alpha=0.3)
    legend = [pyplot.Line2D([], [], linestyle="", label=f"{k}  {name}") for k, name in enumerate(names, 1)]
    figure.legend(
        handles=legend, loc="outside lower center", ncols=2, fontsize=8, handlelength=0, frameon=False
    )
    figure.savefig(path, dpi=100)
    pyplot.close(figure)
