"""Report of a training, `report.json` in its work folder, and quality warnings; read without torch."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, ViewScore
from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import read_json_file
from langsplat_core.scene import Camera

REPORT, PAGE = "report.json", "report.html"
LIMIT = 1_000_000  # bytes; a report has about a thousand
MOST_WARNINGS = 5  # that are taken from a file
LEAST_PSNR = 16.0  # dB: below, held-out photographs are hardly recognised
LEAST_COVERED = 0.5  # of an image's pixels
APART = 10.0  # times the median step to a neighbouring camera; captures that went well have at most 5


@dataclass(frozen=True)
class TrainReport:
    """Figures of a training."""

    views: int
    held_out: int
    gaussians: int
    psnr: float | None  # mean over held-out views, dB; None without held-out views
    masks: str  # name of the mask source
    encoder: str
    mask_count: int
    codec: str  # its kind
    codec_size: int  # codewords of a codebook, numbers per latent of other kinds
    codec_cosine: float  # mean, of a Gaussian's vector with what the codec makes of it
    relevancy_error: float  # mean absolute, of what the codec makes of it, over everyday phrases
    relevancy_error_p99: float
    observed: float  # fraction of Gaussians with language features at the whole level
    warnings: tuple[str, ...]  # quality warnings, each with its remedy
    seconds: dict[str, float]  # per stage, of this run: a stage that was already done takes almost none
    dataset: str = ""  # absolute path of the photographs; "" in reports of earlier versions
    held_out_views: tuple[ViewScore, ...] = ()  # one by one
    psnr_small: float | None = None  # as `psnr`, of images shrunk to 320 px, by which presets compare
    # budget -> mean PSNR (dB) of views held out of the training views, by each training that decided on it
    rehearsed: dict[str, list[float]] = field(default_factory=dict)


def rehearsals_in_words(rehearsed: Mapping[str, Sequence[float]]) -> str:
    """Return ``after 500 steps at 320 px 24.6, 21.1 dB; after 500 steps at 480 px 24.0 dB``."""
    return "; ".join(
        f"after {budget} {', '.join(f'{decibels:.1f}' for decibels in found)} dB"
        for budget, found in rehearsed.items()
    )


def work_folder(out: Path) -> Path:
    """Return the default folder in which the training of a scene keeps its stages."""
    return out.with_name(f"{out.stem}.work")


def write_report(work: Path, report: TrainReport) -> None:
    """Write the report into the work folder, whole or not at all."""
    with atomic_path(work / REPORT) as temporary:
        temporary.write_text(json.dumps(asdict(report), indent=1))


def read_report(work: Path) -> TrainReport:
    """Read the report of the run which has just ended, in this process or another."""
    stated = json.loads((work / REPORT).read_text())
    scores = tuple(ViewScore(**score) for score in stated.get("held_out_views", ()))
    return TrainReport(**stated | {"warnings": tuple(stated["warnings"]), "held_out_views": scores})


def stated_warnings(scene: Path, gaussians: int) -> tuple[str, ...]:
    """Return the quality warnings of the report beside a scene.

    There are none without a report, where it cannot be read, and where it is of a scene with another number
    of Gaussians than this file has.
    """
    try:
        stated = read_json_file(work_folder(scene) / REPORT, LIMIT)
    except (InputError, FormatError):
        return ()
    if not isinstance(stated, dict) or stated.get("gaussians") != gaussians:
        return ()
    warnings = stated.get("warnings")
    lines = warnings[:MOST_WARNINGS] if isinstance(warnings, list) else []
    return tuple(printable_line(line, 300) for line in lines if isinstance(line, str))


def quality_warnings(scores: Sequence[ViewScore], cameras: Sequence[Camera]) -> tuple[str, ...]:
    """Return warnings of a poor scene that was trained without an error, one sentence each, with a remedy.

    scores: of held-out views, or none; cameras: all that were trained on.
    """
    found = []
    if scores:
        psnr = float(np.mean([score.psnr for score in scores]))
        covered = float(np.mean([score.covered for score in scores]))
        if psnr < LEAST_PSNR:
            found.append(
                f"held-out photographs are reproduced at {psnr:.1f} dB, below {LEAST_PSNR:g}: cameras may "
                "be wrong, or photographs too few; take more that overlap, or give COLMAP's cameras"
            )
        if covered < LEAST_COVERED:
            found.append(
                f"only {100 * covered:.0f} % of the held-out pictures' pixels show anything: photograph "
                "what is there from more sides, or train for more steps"
            )
    groups = camera_groups(np.array([camera.position for camera in cameras]).reshape(-1, 3))
    if len(groups) > 1:
        sizes = " and ".join(str(len(group)) for group in groups)
        found.append(
            f"the cameras stand in {len(groups)} groups far apart ({sizes} photographs): they may not belong "
            "together; add photographs between them, or train each group alone"
        )
    return tuple(found)


def camera_groups(positions: Array) -> list[Array]:
    """Return rows of (M, 3) positions in groups that lie `APART`, the largest first.

    Cameras that stand together are one group; a single camera on its own is none.
    """
    from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    whole = [np.arange(len(positions))]
    if len(positions) < 4:
        return whole
    tree = minimum_spanning_tree(squareform(pdist(positions))).toarray()
    steps = tree[tree > 0]
    if len(steps) == 0:
        return whole
    tree[tree > APART * np.median(steps)] = 0
    count, labels = connected_components(tree, directed=False)
    groups = [np.flatnonzero(labels == label) for label in range(count)]
    return sorted((group for group in groups if len(group) > 1), key=len, reverse=True) or whole
