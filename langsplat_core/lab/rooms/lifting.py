"""Ways from masks to meanings, side by side: error and accuracy against seconds and bytes (`bench lift`)."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from langsplat_core.errors import InputError
from langsplat_core.lab.config import BenchmarkConfig, LiftBenchConfig
from langsplat_core.lab.rooms.kept_rows import KeptRows
from langsplat_core.lab.rooms.report import Measured, loss_cells, of_kind
from langsplat_core.lab.rooms.room import Room, weights_digest
from langsplat_core.lab.rooms.variants import Variant, liftings
from langsplat_core.progress import Progress, silent
from langsplat_core.semantics.encoders import load_encoder

_HEAD = (
    *("masks", "what a Gaussian keeps", "mIoU %", "localisation %", "3D IoU %"),
    *("codec", "relevancy error mean / p99", "bytes/Gaussian", "seconds", "ms/query"),
)


_AXES = {"fit_seconds": "seconds from masks to latents", "bytes_per_gaussian": "bytes per Gaussian"}


@dataclass(frozen=True)
class LiftReport:
    """Every way, for every origin of the masks."""

    settings: LiftBenchConfig
    gaussians: int
    rows: tuple[Measured, ...] = field(default=())

    @property
    def text(self) -> str:
        """A Markdown table."""
        lines = ["| " + " | ".join(_HEAD) + " |", "|" + "---|" * len(_HEAD)]
        lines += ["| " + " | ".join(_cells(row)) + " |" for row in self.rows]
        return "\n".join(lines) + "\n"

    @property
    def figures(self) -> dict[str, Any]:
        """All figures."""
        return {
            "settings": asdict(self.settings),
            "gaussians": self.gaussians,
            "rows": [asdict(row) for row in self.rows],
        }


def measure_liftings(
    config: LiftBenchConfig,
    work: Path,
    progress: Progress = silent,
    rooms: BenchmarkConfig | None = None,
    kept: Path | None = None,
) -> LiftReport:
    """In one room, whose photographs and Gaussians are made in `work` first where they are not there.

    Seconds are from masks with vectors to latents, everything in them, in a folder of their own that is
    emptied first: nothing is taken from an earlier run. `rooms`: how the room is photographed and trained.
    `kept`: a file that takes every row when it is made, and gives those that an earlier run has made.
    Raises InputError for settings without a row.
    """
    if not config.masks:
        raise InputError("--masks: name at least one of truth, wrong, graph")
    encoder = load_encoder("demo")
    chosen = {masks: _chosen(liftings(config, masks, encoder.dim), config.only) for masks in config.masks}
    settings = rooms or BenchmarkConfig()
    room = Room(settings, config.tier, config.seed, work, (encoder, weights_digest("demo")), progress)
    matters = asdict(replace(config, masks=(), only=())) | {
        "rooms": asdict(settings),
        "encoder": room.weights,
    }
    rows, earlier = [], None if kept is None else KeptRows(kept, matters)
    for variant in (variant for ways in chosen.values() for variant in ways):
        row = None if earlier is None else earlier.get(variant.masks, variant.name)
        if row is None:
            row = replace(room.measure(variant, fresh=True), name=variant.name)
            if earlier is not None:
                earlier.add(row)
        rows.append(row)
    return LiftReport(config, len(room.gaussians), tuple(rows))


def _chosen(ways: list[Variant], only: Sequence[str]) -> list[Variant]:
    chosen = [way for way in ways if not only or any(text in way.name for text in only)]
    if not chosen:
        raise InputError(
            f"--only {' '.join(only)}: no row has that; the rows are {', '.join(w.name for w in ways)}"
        )
    return chosen


def _cells(row: Measured) -> tuple[str, ...]:
    shares = (f"{100 * share:.1f}" for share in of_kind(row, "all")[1:])
    codec, error, size = loss_cells([row])
    return (row.masks, row.name, *shares, codec, error, size, f"{row.fit_seconds:.0f}", f"{row.query_ms:.1f}")


def plot(rows: Sequence[Measured], path: Path) -> None:
    """Localisation and mIoU against seconds and against bytes per Gaussian, a line of panels per measure."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    rows = [row for row in rows if row.masks == rows[0].masks]
    figure, grid = pyplot.subplots(2, 2, figsize=(13, 9), layout="constrained", sharey="row")
    for line, (title, column) in zip(grid, (("mIoU %", 1), ("localisation %", 2)), strict=True):
        for panel, axis in zip(line, _AXES, strict=True):
            for number, row in enumerate(rows):
                at = max(getattr(row, axis), 0.1), 100 * of_kind(row, "all")[column]
                panel.plot(*at, "o", color=_colour(row.name))
                above = number % 2 == 0
                panel.annotate(
                    row.name,
                    at,
                    fontsize=7,
                    xytext=(4, 4 if above else -9),
                    textcoords="offset points",
                )
            panel.set_xscale("log")
            panel.set_xlabel(
                "seconds from masks to latents" if axis == "fit_seconds" else "bytes per Gaussian"
            )
            panel.grid(alpha=0.3)
        line[0].set_ylabel(title)
    figure.suptitle(f"Ways from masks to meanings ({rows[0].masks} masks)")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _colour(name: str) -> str:
    families = {"paper": "#d55e00", "codebook": "#0072b2", "autoencoder": "#e69f00", "linear": "#009e73"}
    return next((colour for family, colour in families.items() if family in name), "#666666")
