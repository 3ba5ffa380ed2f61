"""The report `verdicts`: how far "found" and "not here" can be trusted, and the calibration of both.

In rooms whose truth is known every thing that is there is asked for, and every thing of the catalogue that is
not; every part alone, and part words that nothing in the room is called by; every part of a thing, and as
many that the thing has not. A calibration is fitted to the fits of each (Platt 1999, with Platt's smoothed
targets); it is fair only to rooms that it was not fitted to.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from statistics import fmean

import numpy as np
from scipy.optimize import minimize

from assets.making.objects import EVERYTHING
from assets.making.truth import Region
from assets.making.vocabulary import part_words
from langsplat_core.arrays import Array
from langsplat_core.bench.measure import markdown
from langsplat_core.cli.run import OutFile
from langsplat_core.config import CodebookConfig, CodecConfig
from langsplat_core.errors import InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.answers import WEAK, QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import PARTS, forms, is_part
from langsplat_core.scene import Calibration, Fits, Odds, Scene
from tests.benchmarks.room import InRooms, MaskOrigin, Room, Variant, publish
from tests.benchmarks.scoring import MIN_GAUSSIANS, separation

REJECTED = 0.95  # of what is absent, in the rooms that a calibration is fitted to
BINS = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)  # of probability
SHARES = (0.9, 0.95, 0.98)  # of absent things rejected, at which acceptance is reported
PAIRS = {  # what is looked for -> the kinds of phrases that are there and that are not
    "thing": ("object", "absent"),
    "part": ("part", "absent part"),
    "inside": ("part of thing", "absent part of thing"),
}


@dataclass(frozen=True)
class Verdicts(InRooms):
    """Things that are there and things that are not, asked for in rooms with known truth: accept and reject
    rates, the ROC curve's area, and how well the probabilities are calibrated."""

    masks: MaskOrigin = "truth"  # where outlines come from
    codec: CodecConfig = field(default_factory=CodebookConfig)
    fit: OutFile | None = None
    """Fit the encoder's calibration to these rooms and write it into this reading.json; measure elsewhere."""

    def run(self) -> None:
        with TerminalProgress() as progress:
            variant = Variant("the method", self.masks, codec=self.codec)
            rows = [row for room in self.rooms(progress) for row in measure_verdicts(room, variant)]
        if self.fit is not None:
            calibration = fit_calibration(rows)
            write_calibration(self.fit, calibration)
            print(f"{self.fit}: {calibration}")
        tables = "\n".join([verdict_table(rows), *(curve_table(rows, asked) for asked in PAIRS)])
        publish(self, "verdicts", "Verdicts: accept and reject rates, and calibration", tables, rows)


@dataclass(frozen=True)
class Verdict:
    """One phrase in one room."""

    tier: str
    seed: int
    text: str
    kind: str  # one of those in `PAIRS`, or "colour+object"
    fits: Fits  # of the best region of each level
    probability: float | None
    found: bool
    excess: float | None = None  # see `QueryResult`


def measure_verdicts(room: Room, variant: Variant) -> list[Verdict]:
    """Every phrase of one room, present and absent, asked of the field of a variant."""
    field, _, _ = room.field(variant)
    engine = QueryEngine(Scene(room.gaussians, field), lambda _: room.encoder)
    parts, absent_parts = _part_words(room)
    asked = [(p.text, p.kind) for p in room.truth.phrases if p.kind in ("object", "colour+object")]
    asked += [(text, "absent") for text in room.truth.absent(EVERYTHING)]
    asked += [(word, "part") for word in parts]
    asked += [(word, "absent part") for word in absent_parts]
    asked = [(text, kind) for text, kind in asked if not engine.unknown_words(text)]
    answers = engine.run_many([text for text, _ in asked])
    rows = [_verdict(room, text, kind, answer) for (text, kind), answer in zip(asked, answers, strict=True)]
    for text, kind in _inside(room, engine):
        rows.append(_verdict(room, text, kind, run_phrase(engine, text).answer))
    return rows


def _verdict(room: Room, text: str, kind: str, answer: QueryResult) -> Verdict:
    return Verdict(
        room.tier, room.seed, text, kind, answer.fits, answer.probability, answer.found, answer.excess
    )


def _part_words(room: Room) -> tuple[list[str], list[str]]:
    """Words of parts that Gaussians of the room show, and such words that nothing in it is called by."""
    seen, counts = np.unique(room.labels, return_counts=True)
    shown = {int(number) for number, count in zip(seen, counts, strict=True) if count >= MIN_GAUSSIANS}
    parts = {
        region.word for number, region in room.truth.regions.items() if number in shown and _part(region)
    }
    return sorted(parts), sorted(_uncalled(PARTS, room.truth.words))


def _inside(room: Room, engine: QueryEngine) -> Iterator[tuple[str, str]]:
    """(phrase, kind): every part of every thing of the room, and as many that it has not."""
    rng = np.random.default_rng((room.seed, 11))
    regions = list(room.truth.regions.values())
    words = sorted({region.word for region in regions if _part(region)})
    words = [word for word in words if not engine.unknown_words(word)]
    for thing in sorted({region.thing for region in regions}):
        own = [region for region in regions if region.thing == thing]
        has = sorted({region.word for region in own if _part(region)} & set(words))
        lacks = _uncalled(words, {word for region in own for word in region.words})
        drawn = rng.permutation(lacks)[: len(has)].tolist()
        if has and not engine.unknown_words(thing):
            yield from ((f"{word} of the {thing}", "part of thing") for word in has)
            yield from ((f"{word} of the {thing}", "absent part of thing") for word in drawn)


def _part(region: Region) -> bool:
    return region.is_part and is_part(region.word)


def _uncalled(words: Iterable[str], called: AbstractSet[str]) -> list[str]:
    """The `words` that neither in this number nor in the other one are among `called`."""
    return sorted(word for word in words if called.isdisjoint({*forms(word), f"{word}s", *part_words(word)}))


def fit_calibration(rows: Sequence[Verdict]) -> Calibration:
    """Odds of all kinds of phrases. Raises as `fit_odds` does."""
    return Calibration(
        **{name: fit_odds(fits_of(rows, there), fits_of(rows, not_)) for name, (there, not_) in PAIRS.items()}
    )


def fit_odds(present: Array, absent: Array) -> Odds:
    """Odds from fits (P, 3) of things that are there and (A, 3) of things that are not, which weigh the same.

    Raises InputError where there are fewer than ten of either, or the fits do not tell them apart.
    """
    if min(len(present), len(absent)) < 10:
        raise InputError(
            "a calibration needs ten things that are there and ten that are not; take more rooms"
        )
    fits = np.concatenate([present, absent])
    features = np.stack([fits[:, 2], fits[:, :2].max(axis=1)], axis=1)
    targets = np.repeat(
        [(len(present) + 1) / (len(present) + 2), 1 / (len(absent) + 2)], [len(present), len(absent)]
    )
    weights = np.repeat([1 / len(present), 1 / len(absent)], [len(present), len(absent)])

    def loss(parameters: Array) -> float:
        logits = parameters[0] + features @ parameters[1:]
        return float((weights * (np.logaddexp(0, logits) - targets * logits)).sum())

    constant, whole, finer = minimize(loss, np.array([0.0, 10.0, 0.0]), method="BFGS").x.round(3)
    if whole + finer <= 0:
        raise InputError("what is there has no larger fits than what is not: nothing to calibrate")
    plain = Odds(float(constant), float(whole), float(finer))
    said = [plain.probability((m[0], m[1], m[2])) for m in absent.tolist()]
    highest = float(np.quantile(said, REJECTED, method="higher"))
    return replace(plain, found=float(np.ceil(1000 * max(highest, WEAK)) / 1000))


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration into a `reading.json`, whose other fields stay."""
    stated = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    stated["calibration"] = asdict(calibration)
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(stated, indent=1) + "\n", encoding="utf-8")


def fits_of(rows: Sequence[Verdict], kind: str) -> Array:
    """(n, 3) fits of one kind of phrase."""
    return np.array([row.fits for row in rows if row.kind == kind])


def verdict_table(rows: Sequence[Verdict]) -> str:
    """Markdown: what is accepted and rejected, and the area under the ROC curve, per tier; means over rooms
    with their standard deviation."""
    at = (f"accepted at {100 * share:.0f} % rejected" for share in SHARES)
    head = ("tier", "asked for", "phrases", "accepted %", "absent rejected %", "ROC area %", *at)
    lines = []
    asked = {"thing": PAIRS["thing"], "colour + thing": ("colour+object", "absent"), **PAIRS}
    for tier in dict.fromkeys(row.tier for row in rows):
        for name, pair in asked.items():
            here = [row for row in rows if row.tier == tier and row.kind in pair]
            seeds = dict.fromkeys(row.seed for row in here)
            rooms = [[row for row in here if row.seed == seed] for seed in seeds]
            if any(row.kind == pair[0] for row in here):
                lines.append((tier, name, len(here), *_spreads([_shares(room, pair) for room in rooms])))
    return markdown(head, lines)


def _shares(rows: Sequence[Verdict], pair: tuple[str, str]) -> tuple[float, ...]:
    present, absent = (np.array([_score(row) for row in rows if row.kind == kind]) for kind in pair)
    found, wrong = (_mean([row.found for row in rows if row.kind == kind]) for kind in pair)
    compared = [float("nan")] * (1 + len(SHARES))  # nothing to compare where one of both was not asked for
    if len(present) and len(absent):
        at = (np.mean(present > np.quantile(absent, share, method="higher")) for share in SHARES)
        compared = [separation(present, absent), *map(float, at)]
    return found, 1 - wrong, *compared


def _mean(values: Sequence[bool]) -> float:
    """NaN of nothing."""
    return float(np.mean(values)) if values else float("nan")


def _score(row: Verdict) -> float:
    """Value that a threshold would be put on."""
    if row.probability is not None:
        return row.probability
    return max(row.fits) if row.excess is None else row.excess


def _spreads(rooms: Sequence[tuple[float, ...]]) -> list[str]:
    return [spread(column[np.isfinite(column)]) for column in 100 * np.array(rooms).T]


def spread(values: Array) -> str:
    """Mean and standard deviation of percentages, as cells of tables have them."""
    if len(values) == 0:
        return "-"
    return f"{values.mean():.1f} +/- {values.std(ddof=1) if len(values) > 1 else 0:.1f}"


@dataclass(frozen=True)
class CurvePoint:
    """Answers with a probability from `low` to `high`; present and absent weigh the same in all."""

    low: float
    high: float
    phrases: int
    said: float  # mean probability
    there: float  # share, 0 to 1


def curve(rows: Sequence[Verdict], asked: str = "thing") -> list[CurvePoint]:
    """The calibration curve, without probabilities that nothing was said with. asked: a key of `PAIRS`."""
    there, not_there = (
        [row.probability for row in rows if row.kind == kind and row.probability is not None]
        for kind in PAIRS[asked]
    )
    points = []
    for low, high in pairwise(BINS):
        right, wrong = ([p for p in said if low <= p < high or high == 1 <= p] for said in (there, not_there))
        if right or wrong:
            # Whole weights and sums that are rounded once: the same figure on every machine, in any order.
            weights = [max(len(not_there), 1)] * len(right) + [max(len(there), 1)] * len(wrong)
            share = sum(weights[: len(right)]) / sum(weights)
            points.append(CurvePoint(low, high, len(weights), fmean(right + wrong, weights), share))
    return points


def curve_table(rows: Sequence[Verdict], asked: str = "thing") -> str:
    """`curve` as Markdown."""
    lines = (
        (f"{p.low:g} to {p.high:g}", p.phrases, f"{100 * p.said:.0f}", f"{100 * p.there:.0f}")
        for p in curve(rows, asked)
    )
    return markdown((f"probability of a {asked} said", "phrases", "mean said %", "there %"), lines)
