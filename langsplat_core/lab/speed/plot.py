"""The benchmark as a picture: small multiples by operation."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.lab.speed.measure import Measurement

_COLOURS = {"cpu": "#0072b2", "opengl half": "#d55e00", "opengl single": "#e69f00", "pytorch": "#666666"}
_COMPARED = {
    "splat": "splat: pixels",
    "gather": "gather: values",
    "backward": "backward: relative",
    "frozen": "frozen (triangles: gathered)",
}
_ORDER = ("project", "frame", "splat", "gather", "backward", "freeze", "frozen splat", "frozen gather")


def plot(rows: Sequence[Measurement], path: Path) -> None:
    """Two lines of panels: milliseconds over Gaussians, at the size with most counts; solid for the fewest,
    dashed for the most channels. Third line: error against time of everything compared."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.lines import Line2D

    random = [r for r in rows if r.scene == "random" and r.milliseconds is not None]
    size = _busiest(random)
    here = [r for r in random if (r.width, r.height) == size]
    channels = sorted({r.channels for r in rows})
    styles = {channels[0]: "-"} | ({channels[-1]: "--"} if len(channels) > 1 else {})
    backends = list(dict.fromkeys(r.backend for r in rows))
    colours = {name: _COLOURS.get(name, f"C{n}") for n, name in enumerate(backends)}
    figure, grid = pyplot.subplots(3, 4, figsize=(13, 10), layout="constrained", squeeze=False)
    operations = [name for name in _ORDER if any(r.operation == name for r in here)]
    panels = [panel for line in grid[:2] for panel in line]
    for panel in panels[len(operations) :]:
        panel.axis("off")
    for panel, operation in zip(panels, operations, strict=False):
        _times(panel, [r for r in here if r.operation == operation], colours, styles)
        panel.set_title(operation)
        _log_axes(panel, [r.gaussians for r in here], [r.milliseconds or 1 for r in here])
    for panel, kind in zip(grid[2], _COMPARED, strict=True):
        _errors(panel, kind, rows, colours)
    handles = [Line2D([], [], color=colours[name], marker="o", label=name) for name in backends]
    handles += [Line2D([], [], color="black", ls=s, label=f"{c} channels") for c, s in styles.items()]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)
    where = f"at {size[0]}x{size[1]} pixels" if size else "(none)"
    figure.suptitle(f"Time of random scenes {where}; error away from cut-offs against time, all cases")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _times(panel: Any, rows: Sequence[Measurement], colours: dict[str, str], styles: dict[int, str]) -> None:
    for backend, colour in colours.items():
        for channels, style in styles.items():
            chosen = [r for r in rows if (r.backend, r.channels) == (backend, channels)]
            chosen.sort(key=lambda r: r.gaussians)
            times = [r.milliseconds for r in chosen]
            panel.plot([r.gaussians for r in chosen], times, style, color=colour, marker="o", ms=4, lw=1.4)
    panel.set(xlabel="Gaussians", ylabel="ms")


def _errors(panel: Any, kind: str, rows: Sequence[Measurement], colours: dict[str, str]) -> None:
    """Error away from cut-offs over the time it took; triangles are gathers."""
    chosen = [r for r in rows if r.operation.startswith(kind) and r.error_off_cuts is not None]
    errors = [max(r.error_off_cuts or 0, 1e-9) for r in chosen]
    times = [r.milliseconds or 1 for r in chosen]
    for r, x, y in zip(chosen, times, errors, strict=True):
        mark = "^" if r.operation.endswith("gather") else "o"
        panel.plot(x, y, mark, color=colours[r.backend], alpha=0.7)
    panel.set(title=_COMPARED[kind], xlabel="ms", ylabel="largest error")
    _log_axes(panel, times, errors)


def _log_axes(panel: Any, x: Sequence[float], y: Sequence[float]) -> None:
    """Logarithmic from one power of ten to another, labelled at powers of ten alone."""
    from matplotlib.ticker import NullFormatter

    panel.set(xscale="log", yscale="log")
    for axis, limit, values in ((panel.xaxis, panel.set_xlim, x), (panel.yaxis, panel.set_ylim, y)):
        axis.set_minor_formatter(NullFormatter())
        if values:
            low, high = np.floor(np.log10(min(values) / 1.1)), np.ceil(np.log10(max(values) * 1.1))
            limit(10.0**low, 10.0**high)
    panel.grid(True, alpha=0.3)


def _busiest(rows: Sequence[Measurement]) -> tuple[int, int] | None:
    """The size that was measured with most numbers of Gaussians."""
    counts: dict[tuple[int, int], set[int]] = {}
    for r in rows:
        counts.setdefault((r.width, r.height), set()).add(r.gaussians)
    return max(counts, key=lambda size: len(counts[size]), default=None)
