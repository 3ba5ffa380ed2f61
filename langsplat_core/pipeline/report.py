"""What a training did, as `report.json` of its work folder says; read without torch."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.files import atomic_path
from langsplat_core.parsing.opening import read_json_file

REPORT = "report.json"
LIMIT = 1_000_000  # bytes; a report has about a thousand
MOST_DOUBTS = 5  # that are taken from a file


@dataclass(frozen=True)
class TrainReport:
    """What a run did."""

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
    observed: float  # fraction of Gaussians with a meaning at the whole level
    doubts: tuple[str, ...]  # what speaks against the scene, with the remedy
    seconds: dict[str, float]  # per stage, of this run: a stage that was already done takes almost none


def work_folder(out: Path) -> Path:
    """Where the training of a scene keeps its stages, if no other folder was named."""
    return out.with_name(f"{out.stem}.work")


def write_report(work: Path, report: TrainReport) -> None:
    """Into the work folder, whole or not at all."""
    with atomic_path(work / REPORT) as temporary:
        temporary.write_text(json.dumps(asdict(report), indent=1))


def read_report(work: Path) -> TrainReport:
    """That of the run which has just ended, in this process or another."""
    stated = json.loads((work / REPORT).read_text())
    return TrainReport(**stated | {"doubts": tuple(stated["doubts"])})


def stated_doubts(scene: Path, gaussians: int) -> tuple[str, ...]:
    """What the report beside a scene says against it. Nothing where there is no report, where it cannot be
    read, or where it is of a scene with another number of Gaussians than this file has."""
    try:
        stated = read_json_file(work_folder(scene) / REPORT, LIMIT)
    except (InputError, FormatError):
        return ()
    if not isinstance(stated, dict) or stated.get("gaussians") != gaussians:
        return ()
    said = stated.get("doubts")
    lines = said[:MOST_DOUBTS] if isinstance(said, list) else []
    return tuple(printable_line(line, 300) for line in lines if isinstance(line, str))
