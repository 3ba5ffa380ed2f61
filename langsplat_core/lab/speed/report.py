"""What the benchmark's figures say: growth with size, the ratios the project promises, tables and JSON."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from langsplat_core.lab.speed.machine_limit import Need
from langsplat_core.lab.speed.measure import Measurement


@dataclass(frozen=True)
class Growth:
    """milliseconds ~ size^exponent, fitted over the random scenes."""

    backend: str
    operation: str
    channels: int
    by: str  # "Gaussians" or "pixels"
    exponent: float
    points: int


@dataclass(frozen=True)
class Reach:
    """How much of the machine's multiply-add rate a splat uses."""

    scene: str
    gaussians: int
    width: int
    height: int
    channels: int
    rows: int  # of sixteen pixels that must be visited
    useful_lanes: float  # fraction of those rows' lanes that blend something
    gigaflops: float  # needed operations per second of the splat, 1e9
    fraction: float  # of the machine's peak


@dataclass(frozen=True)
class _Which:
    """Picks a measurement of a random scene."""

    backend: str
    operation: str
    gaussians: int
    size: tuple[int, int]
    channels: int

    def find(self, rows: Sequence[Measurement]) -> float | None:
        """Milliseconds, if measured."""
        for r in rows:
            key = (r.backend, r.operation, r.gaussians, (r.width, r.height), r.channels)
            if r.scene == "random" and key == (
                self.backend, self.operation, self.gaussians, self.size, self.channels
            ):  # fmt: skip
                return r.milliseconds
        return None


@dataclass(frozen=True)
class _Promise:
    text: str
    above: _Which
    below: _Which
    target: float
    at_least: bool  # else at most


_LARGE, _SMALL = (200_000, (960, 720)), (31_000, (320, 240))
PROMISED_CASES = (_SMALL, _LARGE)
_PROMISES = (
    _Promise(
        "12 channels, 200k, 960x720: OpenGL half frame / CPU frame",
        _Which("opengl half", "frame", *_LARGE, 12), _Which("cpu", "frame", *_LARGE, 12), 3.0, True,
    ),
    _Promise(
        "12 channels, 200k, 960x720: OpenGL half splat / CPU splat",
        _Which("opengl half", "splat", *_LARGE, 12), _Which("cpu", "splat", *_LARGE, 12), 3.0, True,
    ),
    _Promise(
        "3 channels, 31k, 320x240: PyTorch frame / CPU frame",
        _Which("pytorch", "frame", *_SMALL, 3), _Which("cpu", "frame", *_SMALL, 3), 50.0, True,
    ),
    _Promise(
        "3 channels, 31k, 320x240: PyTorch backward / CPU backward",
        _Which("pytorch", "backward", *_SMALL, 3), _Which("cpu", "backward", *_SMALL, 3), 10.0, True,
    ),
    _Promise(
        "3 channels, 31k, 320x240: CPU gather / splat",
        _Which("cpu", "gather", *_SMALL, 3), _Which("cpu", "splat", *_SMALL, 3), 1.5, False,
    ),
    _Promise(
        "200k, 960x720: CPU splat of 12 / of 3 channels",
        _Which("cpu", "splat", *_LARGE, 12), _Which("cpu", "splat", *_LARGE, 3), 1.6, False,
    ),
    _Promise(
        "200k, 960x720: CPU frame of 12 / of 3 channels",
        _Which("cpu", "frame", *_LARGE, 12), _Which("cpu", "frame", *_LARGE, 3), 1.6, False,
    ),
    _Promise(
        "3 channels, 31k, 320x240: CPU frame / frozen splat",
        _Which("cpu", "frame", *_SMALL, 3), _Which("cpu", "frozen splat", *_SMALL, 3), 4.0, True,
    ),
    _Promise(
        "3 channels, 31k, 320x240: CPU splat / frozen splat",
        _Which("cpu", "splat", *_SMALL, 3), _Which("cpu", "frozen splat", *_SMALL, 3), 4.0, True,
    ),
    _Promise(
        "3 channels, 31k, 320x240: CPU gather / frozen gather",
        _Which("cpu", "gather", *_SMALL, 3), _Which("cpu", "frozen gather", *_SMALL, 3), 4.0, True,
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Ratio:
    """A promise and what was measured."""

    text: str
    ratio: float | None  # None: not measured in this run
    target: str  # ">= 3" or "<= 2"
    met: bool | None


def ratios(rows: Sequence[Measurement]) -> list[Ratio]:
    """Every promised ratio, from the rows of one run."""
    found = []
    for p in _PROMISES:
        above, below = p.above.find(rows), p.below.find(rows)
        value = above / below if above is not None and below is not None else None
        met = None if value is None else (value >= p.target if p.at_least else value <= p.target)
        found.append(Ratio(p.text, value, f"{'>=' if p.at_least else '<='} {p.target:g}", met))
    return found


def fit_exponent(sizes: Sequence[float], milliseconds: Sequence[float]) -> float:
    """Least-squares slope of log(milliseconds) over log(size)."""
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(milliseconds, float))
    return float(np.polyfit(x, y, 1)[0])


def growth(rows: Sequence[Measurement]) -> list[Growth]:
    """Exponents in Gaussians at one size, and in pixels at one count, where at least three points lie."""
    ways: tuple[tuple[str, Callable[[Measurement], float], Callable[[Measurement], object]], ...] = (
        ("Gaussians", lambda r: r.gaussians, lambda r: (r.width, r.height)),
        ("pixels", lambda r: r.width * r.height, lambda r: r.gaussians),
    )
    found = []
    for by, size, fixed in ways:
        groups: dict[tuple[object, ...], list[tuple[float, float]]] = {}
        for r in rows:
            if r.scene == "random" and r.milliseconds is not None:
                key = (r.backend, r.operation, r.channels, fixed(r))
                groups.setdefault(key, []).append((size(r), r.milliseconds))
        for (backend, operation, channels, _), points in groups.items():
            if len({x for x, _ in points}) >= 3:
                exponent = fit_exponent(*zip(*points, strict=True))
                found.append(
                    Growth(str(backend), str(operation), int(str(channels)), by, exponent, len(points))
                )
    return found


def reaches(
    rows: Sequence[Measurement], needs: dict[tuple[str, int, int, int], Need], peak: float
) -> list[Reach]:
    """CPU splats whose need was counted. `needs` by (scene, Gaussians, width, height); peak in flop/s."""
    found = []
    for r in rows:
        need = needs.get((r.scene, r.gaussians, r.width, r.height))
        if r.backend == "cpu" and r.operation == "splat" and r.milliseconds and need is not None:
            rate = need.flops(r.channels) / (1e-3 * r.milliseconds)
            useful = need.entries / max(16 * need.rows, 1)
            found.append(
                Reach(
                    r.scene,
                    r.gaussians,
                    r.width,
                    r.height,
                    r.channels,
                    need.rows,
                    useful,
                    rate / 1e9,
                    rate / peak,
                )
            )
    return found


def table(rows: Sequence[Measurement]) -> str:
    """The measurements in Markdown."""
    lines = [
        "| scene | Gaussians | size | channels | operation | backend | ms | MiB | error off cut-offs "
        "| largest error | flips |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        time = r.note or ("-" if r.milliseconds is None else f"{r.milliseconds:.4g}")
        cells = [r.scene, r.gaussians, f"{r.width}x{r.height}", r.channels, r.operation, r.backend, time]
        cells += [_cell(r.peak_mib, ".1f"), _cell(r.error_off_cuts, ".1e"), _cell(r.largest_error, ".1e")]
        lines.append("| " + " | ".join(str(c) for c in [*cells, _cell(r.flips, "d")]) + " |")
    return "\n".join(lines) + "\n"


def growth_table(found: Sequence[Growth]) -> str:
    """Exponents in Markdown: one row per backend and operation."""
    columns = sorted({(g.by, g.channels) for g in found})
    lines = ["| backend | operation | " + " | ".join(f"{by}, {c} ch" for by, c in columns) + " |"]
    lines.append("|---" * (len(columns) + 2) + "|")
    for backend, operation in dict.fromkeys((g.backend, g.operation) for g in found):
        of = {
            (g.by, g.channels): g.exponent for g in found if (g.backend, g.operation) == (backend, operation)
        }
        cells = [_cell(of.get(column), ".2f") for column in columns]
        lines.append(f"| {backend} | {operation} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def ratio_table(found: Sequence[Ratio]) -> str:
    """Promises in Markdown."""
    lines = ["| ratio | measured | target | met |", "|---|---|---|---|"]
    words = {None: "not measured", True: "yes", False: "NO"}
    lines += [f"| {r.text} | {_cell(r.ratio, '.2f')} | {r.target} | {words[r.met]} |" for r in found]
    return "\n".join(lines) + "\n"


def reach_table(found: Sequence[Reach], peak: float) -> str:
    """The distance to the machine's limit in Markdown."""
    lines = [
        f"Peak of this machine, all cores, measured: {peak / 1e9:.0f} Gflop/s (float32 multiply-adds).",
        "",
        "| scene | Gaussians | size | channels | rows of 16 | lanes that blend | Gflop/s | of the peak |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.scene} | {r.gaussians} | {r.width}x{r.height} | {r.channels} | {r.rows} "
        f"| {r.useful_lanes:.0%} | {r.gigaflops:.1f} | {r.fraction:.0%} |"
        for r in found
    ]
    return "\n".join(lines) + "\n"


def as_records(found: Sequence[Measurement | Growth | Ratio | Reach]) -> list[dict[str, object]]:
    """Plain dictionaries, for JSON."""
    return [asdict(row) for row in found]


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
