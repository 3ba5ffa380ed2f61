"""The report `lifting`: methods from masks to answers in rooms with known truth.

The paper's with and without its autoencoder, its training from both starts, lifted CLIP vectors behind every
codec, and ours with one part taken out, all with the same Gaussians, outlines and encoder.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import (
    AutoencoderConfig,
    CodebookConfig,
    Count,
    LiftConfig,
    LinearConfig,
)
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.training.language.codec_fit import CodecReport
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import (
    DirectScore,
    Measured,
    Score,
    grouped,
    loss_cells,
    of_kind,
)

OURS = "ours"
KINDS = ("object", "part", "subpart", "all")


@dataclass(frozen=True)
class Lifting(InRooms):
    """Compare the paper's method, with and without its autoencoder, every codec and ours in rooms.

    Accuracy in images and among Gaussians, relevancy error, bytes, seconds. Hours; rows are kept as they are
    made."""

    masks: tuple[MaskOrigin, ...] = ("truth",)
    """Exact outlines, the same with every seventh vector another region's, the weight-free segmenter's."""
    codec_steps: Count = 4_000
    """Training steps of the autoencoders."""
    gradient_steps: Count = 3_000
    """Steps of the paper's training; it takes 30 000."""
    only: tuple[str, ...] = ()
    """Methods whose name holds one of these texts; all of them if empty."""

    def run(self) -> None:
        kept = KeptRows(self.out / "lifting.rows.jsonl")
        rows = self.each(lambda room: measure_methods(room, self, kept))
        publish(self, "lifting", "From masks to answers", method_table(rows), rows)


@dataclass(frozen=True)
class MethodRow:
    """One method in one room."""

    seed: int
    measured: Measured

    @property
    def image_ms(self) -> float:
        """Milliseconds from a new phrase to one image; the paper has no answer before the image."""
        own = self.measured.query == "blend answers"
        return self.measured.frame_ms + (self.measured.query_ms if own else 0.0)


def methods(command: Lifting, masks: MaskOrigin, dim: int) -> list[Variant]:
    """All methods. dim: numbers of the encoder's vectors."""
    ours = Variant(OURS, masks)
    latents = {d: AutoencoderConfig(latent_dim=d, steps=command.codec_steps) for d in (1, 2, 3, 8)}
    everything = LinearConfig(latent_dim=dim)  # which loses nothing
    trained = LiftConfig(mode="gradient", steps=command.gradient_steps)
    from_zeros = replace(trained, start="zeros-as-published")
    paper = replace(ours, codec=latents[3], lift=LiftConfig(mode="one-pass"), query="paper")
    theirs: dict[str, dict[str, Any]] = {
        "the paper: autoencoder d = 3, trained": {"lift": trained},
        "the paper, trained from zeros": {"lift": from_zeros},
        f"the paper without its autoencoder: {dim} numbers": {"codec": everything},
        **{f"the paper in one pass, d = {d}": {"codec": codec} for d, codec in latents.items()},
        "one-pass latents, answers blended": {"query": "blend answers"},
    }
    changed: dict[str, dict[str, Any]] = {
        "mean and autoencoder d = 3": {"codec": latents[3], "lift": LiftConfig(mode="mean")},
        "autoencoder d = 3": {"codec": latents[3]},
        "64 linear numbers": {"codec": LinearConfig(latent_dim=64)},
        **{f"codebook of {size}": {"codec": CodebookConfig(size=size)} for size in (256, 1_024, 4_096)},
        f"all {dim} numbers": {"codec": everything},
        **{f"level {level} alone": {"level": level} for level in ("subpart", "part", "whole")},
    }
    if masks == "truth":
        changed["masks of the weight-free segmenter"] = {"masks": "graph"}
    return [
        ours,
        *(replace(paper, name=name, **parts) for name, parts in theirs.items()),
        *(replace(ours, name=f"{OURS}, {name}", **parts) for name, parts in changed.items()),
    ]


class KeptRows:
    """Rows of a long report in a file of JSON lines, each under everything that it depends on, so that an
    interrupted run goes on where it stopped; rows of other settings are passed over."""

    def __init__(self, path: Path) -> None:
        """Raises FormatError for a damaged file."""
        self._path = path
        self._rows: dict[str, Measured] = {}
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                stored = json.loads(line)
                self._rows[_text(stored["key"])] = _measured(stored["row"])
            except (ValueError, KeyError, TypeError) as error:
                raise FormatError(f"{path}: damaged ({error}); delete it and run again") from None

    def row(self, key: dict[str, Any], measure: Callable[[], Measured]) -> Measured:
        """The row of a key, measured and kept if no earlier run has done so."""
        text = _text(key)
        if text not in self._rows:
            self._rows[text] = measure()
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "row": asdict(self._rows[text])}, default=str) + "\n")
        return self._rows[text]


def _text(key: dict[str, Any]) -> str:
    return json.dumps(key, sort_keys=True, default=str)


def _measured(row: dict[str, Any]) -> Measured:
    scores = tuple(Score(**score) for score in row.pop("scores"))
    direct = tuple(DirectScore(**score) for score in row.pop("direct"))
    loss, unknown = CodecReport(**row.pop("codec_loss")), tuple(row.pop("unknown"))
    return Measured(scores=scores, direct=direct, codec_loss=loss, unknown=unknown, **row)


def measure_methods(room: Room, command: Lifting, kept: KeptRows) -> Iterator[MethodRow]:
    """Every chosen method in one room. Seconds of a fit are of everything in it, with nothing taken from an
    earlier run. Raises InputError where --only names none."""
    every = [variant for masks in command.masks for variant in methods(command, masks, room.encoder.dim)]
    chosen = [v for v in every if not command.only or any(text in v.name for text in command.only)]
    if not chosen:
        names = ", ".join(dict.fromkeys(v.name for v in every))
        raise InputError(f"--only {' '.join(command.only)}: no method has that; they are {names}")
    config = room.config
    base = {"room": f"{room.tier} {room.seed}", "encoder": room.weights, "most": config.max_gaussians}
    base |= {name: getattr(config, name) for name in ("views", "size", "steps")}
    base |= {name: getattr(command, name) for name in ("codec_steps", "gradient_steps")}
    for variant in chosen:
        key = base | {"masks": variant.masks, "method": variant.name}
        yield MethodRow(room.seed, kept.row(key, partial(room.measure, variant, fresh=True)))


def method_table(rows: Sequence[MethodRow]) -> str:
    """Markdown: means over rooms, with the standard deviation of mIoU where there are several."""
    lines = []
    for (masks, name), same in grouped(rows, "measured.masks", "measured.name").items():
        cells = [_cell(np.array([of_kind(row.measured, kind)[1:] for row in same])) for kind in KINDS]
        seconds = np.mean([row.measured.fit_seconds for row in same])
        times = f"{seconds:.0f}", f"{np.mean([row.image_ms for row in same]):.0f}"
        lines.append((masks, name, *cells, *loss_cells([row.measured for row in same]), *times))
    shares = (f"{kind}: mIoU / loc / 3D %" for kind in KINDS)
    codec = ("codec", "relevancy error mean / p99", "bytes/Gaussian", "s to fit", "ms from phrase to image")
    return markdown(("masks", "method", *shares, *codec), lines)


def _cell(shares: Array) -> str:
    """(rooms, 3) -> such as "83.8 / 96.0 / 81.6 +/- 5.4"; the spread is that of the first."""
    mean = " / ".join(f"{100 * share:.1f}" for share in shares.mean(axis=0))
    return mean if len(shares) < 2 else f"{mean} +/- {100 * shares[:, 0].std(ddof=1):.1f}"
