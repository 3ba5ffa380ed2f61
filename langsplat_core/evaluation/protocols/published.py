"""What others published on the benchmarks, to stand beside a table: mIoU and localisation, percent.

LERF and LangSplat: from the paper of LangSplat (CVPR 2024), 3D-OVS's own figures too; N2F2 (ECCV 2024),
LangSplatV2 (NeurIPS 2025) and Occam's LGS (BMVC 2025) as later papers repeat them. Figures of other machines,
masks and trainings: to see where one stands, not to rank by a point.
"""

from collections.abc import Mapping
from types import MappingProxyType

from langsplat_core.evaluation.protocols.report import BenchmarkReport, summary

Row = Mapping[str, tuple[float, float | None]]  # scene -> mIoU and localisation


_LERF_OVS = """
              figurines  teatime    ramen      waldo_kitchen
LERF          38.6/75.0  45.0/84.8  28.2/62.0  37.9/72.7
LangSplat     44.7/80.4  65.1/88.1  51.2/73.2  44.5/95.5
LangSplatV2   56.4/82.1  72.2/93.2  51.8/74.7  59.1/95.5
Occam's_LGS   58.6/80.4  70.2/93.2  51.0/74.7  65.3/81.8
"""
_OVS_3D = """
              bed   bench  room  sofa  lawn
LERF          73.5  53.2   46.6  27.0  73.7
3D-OVS        89.5  89.3   92.8  74.0  88.2
LangSplat     92.5  94.2   94.1  90.0  96.1
N2F2          93.8  92.6   93.5  92.1  96.3
"""


def _rows(table: str) -> Mapping[str, Row]:
    """Of a table as above."""
    head, *lines = table.strip().splitlines()
    return {
        name.replace("_", " "): dict(zip(head.split(), map(_pair, cells), strict=True))
        for name, *cells in (line.split() for line in lines)
    }


def _pair(cell: str) -> tuple[float, float | None]:
    iou, _, place = cell.partition("/")
    return float(iou), float(place) if place else None


PUBLISHED: Mapping[str, Mapping[str, Row]] = MappingProxyType(
    {"lerf-ovs": _rows(_LERF_OVS), "3d-ovs": _rows(_OVS_3D)}
)


def beside_published(report: BenchmarkReport) -> str:
    """Markdown: a column per scene of the report that others published too, and their mean; a row for the
    report, and one for each of them. "" where there is no such scene."""
    others = PUBLISHED.get(report.benchmark, {})
    scenes = [name for name in report.scenes if any(name in row for row in others.values())]
    if not scenes:
        return ""
    means = summary(report)
    ours = {
        name: (
            100 * means[name].iou,
            None if means[name].localisation is None else 100 * (means[name].localisation or 0),
        )
        for name in scenes
    }
    lines = [
        f"| mIoU % / localisation % | {' | '.join(scenes)} | mean |",
        "|---|" + "---|" * (len(scenes) + 1),
    ]
    for method, row in {"this scene": ours, **others}.items():
        shared = [row[name] for name in scenes if name in row]
        mean = _mean([pair[0] for pair in shared]), _mean([pair[1] for pair in shared])
        cells = [_cell(row.get(name)) for name in scenes]
        lines.append(
            f"| {method} | {' | '.join(cells)} | {_cell(mean if len(shared) == len(scenes) else None)} |"
        )
    return "\n".join(lines)


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if values and len(known) == len(values) else None


def _cell(pair: tuple[float | None, float | None] | None) -> str:
    if pair is None or pair[0] is None:
        return "-"
    return f"{pair[0]:.1f}" if pair[1] is None else f"{pair[0]:.1f} / {pair[1]:.1f}"
