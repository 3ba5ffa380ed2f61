"""Reports on answers in rooms with known truth.

* rooms: localisation, segmentation and rejection, and an error budget, which swaps one stage at a time for
  one that makes no mistake;
* lifting: methods from masks to answers: the paper's with and without its autoencoder, its training from both
  starts, lifted CLIP vectors behind every codec, and ours with one part taken out;
* verdicts: accept and reject rates, how well probabilities are calibrated, how often chance fits as well, and
  things that are shown in one room and asked for in another.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise, permutations, product
from statistics import fmean
from typing import Any

import numpy as np

from assets.making.dataset import PHRASE_KINDS, Region
from assets.making.kit import COLOURS
from assets.making.objects import EVERYTHING
from assets.making.world import TIERS, Tier, part_words
from langsplat_core.arrays import Array, logit, sigmoid
from langsplat_core.cli.arguments import OutFile
from langsplat_core.config import (
    CodecConfig,
    Count,
    LiftConfig,
)
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.io.files import write_json
from langsplat_core.pipeline.encoder_check import fit_scaling
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import PARTS, forms, is_part
from langsplat_core.query.rule import IN_SPREADS, RULE
from langsplat_core.scene import Calibration, Fits, TaughtWord
from langsplat_core.training.radiance.differentiable import evaluate_views
from tests.benchmarks.room import HOLD_OUT, InRooms, MaskOrigin, Room, Seeds, Variant, publish
from tests.benchmarks.scoring import (
    MIN_GAUSSIANS,
    Measured,
    direct_share,
    grouped,
    loss_cells,
    of_kind,
    separation,
    spread,
)


@dataclass(frozen=True)
class Rooms(InRooms):
    """Localisation, segmentation and rejection in procedural rooms, in views that training did not see.

    Rooms are rendered and trained first, some minutes each; an interrupted run continues where it stopped."""

    tiers: tuple[Tier, ...] = TIERS  # how crowded the rooms are
    seeds: Seeds = (101,)
    """One room of every tier each; never the bundled scene's."""
    masks: MaskOrigin = "truth"  # where outlines come from
    codec: CodecConfig = field(default_factory=CodecConfig)
    lift: LiftConfig = field(default_factory=LiftConfig)
    budget: bool = False  # also swap one stage at a time for one that makes no mistake
    codec_steps: Count = 4_000  # of training the autoencoder of --budget

    def run(self) -> None:
        reports = self.each(lambda room: [room_report(room, variants(self, room.encoder.dim))])
        tables = [score_table(reports), room_table(reports)]
        if self.budget:
            tables.append(budget_table(reports))
        unknown = sum(len(report.measured[0].unknown) for report in reports)
        if unknown:
            tables.append(f"left out: {unknown} phrases with words that the encoder was never taught\n")
        publish(self, "rooms", "Rooms with known truth", "\n".join(tables), reports)


@dataclass(frozen=True)
class RoomReport:
    tier: str
    seed: int
    views: int  # trained on
    held_out: int
    gaussians: int
    psnr: float  # mean over held-out views, dB
    encoder: str
    measured: tuple[Measured, ...]  # the method first
    seconds: dict[str, float]  # per stage, of this run: a stage that was already done takes almost none


def variants(command: Rooms, dim: int) -> list[Variant]:
    """The method first; then, with --budget, one variant per stage, which differs in that stage alone.
    dim: numbers of the encoder's vectors."""
    method = Variant("the method", command.masks, codec=command.codec, lift=command.lift)
    if not command.budget:
        return [method]
    perfect = [replace(method, name="perfect masks", masks="truth")] if command.masks != "truth" else []
    decoded = replace(
        method, name="autoencoder, d = 3", codec=CodecConfig("autoencoder", steps=command.codec_steps)
    )
    return [
        method,
        *perfect,
        replace(method, name="perfect embeddings", vectors="text"),
        replace(method, name="no codec", codec=CodecConfig("linear", latent_dim=dim)),
        decoded,
        replace(decoded, name="autoencoder, the paper's order", query="paper"),
    ]


def room_report(room: Room, chosen: Sequence[Variant]) -> RoomReport:
    _, held_out = room.capture.split(HOLD_OUT)
    rows = tuple(room.measure(variant) for variant in chosen)
    views = evaluate_views(room.gaussians, room.capture, held_out)
    return RoomReport(
        tier=room.tier,
        seed=room.seed,
        views=len(room.capture) - len(held_out),
        held_out=len(held_out),
        gaussians=len(room.gaussians),
        psnr=float(np.mean([view.psnr for view in views])),
        encoder=room.encoder.id,
        measured=rows,
        seconds=room.seconds,
    )


def score_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: the method, per tier and kind of phrase: means over the rooms, and the standard deviation
    between them where there are several."""
    head = ("tier", "phrases", "queries", "mIoU %", "localisation %", "3D IoU %", "right regions: 3D IoU %")
    lines = []
    for tier, rooms in grouped(reports, "tier").items():
        for kind in (*PHRASE_KINDS, "all"):
            of_rooms = [of_kind(room.measured[0], kind) for room in rooms]
            count = sum(queries for queries, *_ in of_rooms)
            if count:
                shares = 100 * np.array([row[1:] for row in of_rooms]).T
                ceilings = 100 * np.array([direct_share(room.measured[0], kind, "ceiling") for room in rooms])
                spreads = [
                    spread(values) for values in (*shares, ceilings if any(ceilings) else ceilings[:0])
                ]
                lines.append((tier, kind, count, *spreads))
    return markdown(head, lines)


def room_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: the method, per tier, what is not per kind of phrase."""
    head = ("tier", "Gaussians", "PSNR dB", "objects found", "absent rejected", "separation %")
    lines = []
    for tier, rooms in grouped(reports, "tier").items():
        ours = [room.measured[0] for room in rooms]
        objects, absent = sum(m.objects for m in ours), sum(m.absent for m in ours)
        accepted = sum(m.accepted * m.objects for m in ours) / max(objects, 1)
        lines.append((
            tier,
            round(np.mean([room.gaussians for room in rooms])),
            f"{np.mean([room.psnr for room in rooms]):.1f}",
            f"{_percent(accepted)} % of {objects}",
            f"{_rejected(ours)} % of {absent}",
            _percent(float(np.mean([m.separation for m in ours]))),
            f"{np.median([m.query_ms for m in ours]):.1f}",
            f"{np.median([m.frame_ms for m in ours]):.1f}",
        ))  # fmt: skip
    return markdown((*head, "ms/query", "ms/image"), lines)


def budget_table(reports: Sequence[RoomReport]) -> str:
    """Markdown: per tier and swapped stage, means over the rooms and the difference to the method, in
    percentage points."""
    head = ("tier", "swapped", "mIoU %", "+/-", "localisation %", "+/-", "3D IoU %", "+/-", "rejected %")
    lines = []
    for tier, rooms in grouped(reports, "tier").items():
        base = _means(room.measured[0] for room in rooms)
        for row in range(min(len(room.measured) for room in rooms)):
            ours = [room.measured[row] for room in rooms]
            cells = [tier, f"nothing ({ours[0].masks} masks)" if row == 0 else ours[0].name]
            for mean, of_method in zip(_means(ours), base, strict=True):
                cells += [_percent(mean), f"{100 * (mean - of_method):+.1f}" if row else ""]
            lines.append((*cells, _rejected(ours), *loss_cells(ours)))
    return markdown((*head, "codec", "relevancy error mean / p99", "bytes/Gaussian"), lines)


def _means(measured: Iterable[Measured]) -> tuple[float, ...]:
    """Mean IoU, localisation and 3-D IoU over all phrases, mean over the rooms."""
    return tuple(float(x) for x in np.mean([of_kind(m, "all")[1:] for m in measured], axis=0))


def _rejected(measured: Sequence[Measured]) -> str:
    return _percent(sum(m.rejected * m.absent for m in measured) / max(sum(m.absent for m in measured), 1))


def _percent(share: float) -> str:
    return f"{100 * share:.1f}"


# Methods from masks to answers.

OURS = "ours"
KINDS = ("object", "part", "subpart", "all")


@dataclass(frozen=True)
class Lifting(InRooms):
    """Compare the paper's method, with and without its autoencoder, every codec and ours in rooms.

    Accuracy in images and among Gaussians, relevancy error, bytes, seconds. Hours."""

    masks: tuple[MaskOrigin, ...] = ("truth",)
    """Exact outlines, the same with every seventh vector another region's, the weight-free segmenter's."""
    codec_steps: Count = 4_000
    """Training steps of the autoencoders."""
    gradient_steps: Count = 3_000
    """Steps of the paper's training; it takes 30 000."""
    only: tuple[str, ...] = ()
    """Methods whose name holds one of these texts; all of them if empty."""

    def run(self) -> None:
        rows = self.each(lambda room: measure_methods(room, self))
        publish(self, "lifting", "From masks to answers", method_table(rows), rows)


@dataclass(frozen=True)
class MethodRow:
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
    latents = {d: CodecConfig("autoencoder", latent_dim=d, steps=command.codec_steps) for d in (1, 2, 3, 8)}
    everything = CodecConfig("linear", latent_dim=dim)  # which loses nothing
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
        "64 linear numbers": {"codec": CodecConfig("linear", latent_dim=64)},
        **{f"codebook of {size}": {"codec": CodecConfig(size=size)} for size in (256, 1_024, 4_096)},
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


def measure_methods(room: Room, command: Lifting) -> Iterator[MethodRow]:
    """Every chosen method in one room. Seconds of a fit are of everything in it, with nothing taken from an
    earlier run. Raises InputError where --only names none."""
    every = [variant for masks in command.masks for variant in methods(command, masks, room.encoder.dim)]
    chosen = [v for v in every if not command.only or any(text in v.name for text in command.only)]
    if not chosen:
        names = ", ".join(dict.fromkeys(v.name for v in every))
        raise InputError(f"--only {' '.join(command.only)}: no method has that; they are {names}")
    for variant in chosen:
        yield MethodRow(room.seed, room.measure(variant, fresh=True))


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


# How far "found" and "not here" can be trusted, and the calibration of both. Every thing that is there is
# asked for, and every thing of the catalogue that is not; every part alone, and part words that nothing in
# the room is called by; every part of a thing, and as many that the thing has not. A calibration is fitted to
# the fits of each (Platt 1999, with Platt's smoothed targets); it is fair only to rooms that it was not
# fitted to.

BINS = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)  # of probability
SHARES = (0.9, 0.95, 0.98)  # of absent things rejected, at which acceptance is reported
PAIRS = {  # field of `Calibration` -> the kinds of phrases that are there and that are not
    "thing": ("object", "absent"),
    "coloured_thing": ("colour+object", "absent colour+object"),
    "part": ("part", "absent part"),
    "coloured_part": ("colour+part", "absent colour+part"),
    "inside": ("part of thing", "absent part of thing"),
}
SHOWN = {"thing shown elsewhere": ("shown", "absent shown")}  # these answer by likeness to examples
MARGINS = (-2.0, -1.0, -0.5, 0.0, 0.5, 1.0)  # spreads above what counts as found


@dataclass(frozen=True)
class Verdicts(InRooms):
    """Things that are there and things that are not, asked for in rooms with known truth: accept and reject
    rates, the ROC curve's area, and how well the probabilities are calibrated."""

    masks: MaskOrigin = "truth"  # where outlines come from
    codec: CodecConfig = field(default_factory=CodecConfig)
    fit: OutFile | None = None
    """Fit the encoder's calibration to these rooms and write it into this reading.json; measure elsewhere."""
    by_chance: bool = False  # judge as where no calibration is known
    taught: bool = False  # also show every thing in one room and ask for it in all others

    def run(self) -> None:
        rooms = self.each(lambda room: [(room, self._engine(room))])
        rows = [row for room, engine in rooms for row in measure_verdicts(room, engine)]
        if self.taught:
            rows += ask_elsewhere([show_things(room, engine) for room, engine in rooms])
        if self.fit is not None:
            calibration = fit_calibration(rows)
            stated = json.loads(self.fit.read_text(encoding="utf-8")) if self.fit.exists() else {}
            write_json(self.fit, stated | {"calibration": asdict(calibration)})
            print(f"{self.fit}: {calibration}")
        curves = [curve_table(rows, asked) for asked in PAIRS]
        tables = "\n".join([verdict_table(rows), *curves, chance_table(rows)])
        publish(self, "verdicts", "Verdicts: accept and reject rates, and calibration", tables, rows)

    def _engine(self, room: Room) -> QueryEngine:
        engine = room.engine(Variant("the method", self.masks, codec=self.codec))
        if not self.by_chance:
            return engine
        field = replace(engine.field, calibration=None)
        return QueryEngine(replace(engine.scene, language=field), lambda _: room.encoder)


@dataclass(frozen=True)
class Verdict:
    tier: str
    seed: int
    text: str
    kind: str  # one of those in `PAIRS` and `SHOWN`
    fits: Fits  # of the best region of each level
    common: float  # mean fit of the regions
    probability: float | None
    found: bool
    excess: float | None = None  # spreads above what is found; None where the verdict is not reached by these


def _verdict(room: Room, text: str, kind: str, answer: QueryResult) -> Verdict:
    excess = answer.judgement.margin if answer.judgement.reached in IN_SPREADS else None
    said = answer.probability, answer.found, excess
    return Verdict(room.tier, room.seed, text, kind, answer.fits, answer.common, *said)


def measure_verdicts(room: Room, engine: QueryEngine) -> list[Verdict]:
    """Every phrase of one room, present and absent."""
    (parts, no_parts), truth = _part_words(room), room.truth
    asked = [(p.text, p.kind) for p in truth.phrases if p.kind in ("object", "colour+object")]
    things, nothing = [text for text, kind in asked if kind == "object"], truth.absent(EVERYTHING)
    own = {f"{item.colour} {item.word}" for item in truth.regions.values() if item.colour and _part(item)}
    asked += [(text, "colour+part") for text in sorted(own) if text.split()[-1] in parts]
    for kind, there, absent in (("object", things, nothing), ("part", parts, no_parts)):
        asked += product(absent, ["absent" if kind == "object" else "absent part"])
        asked += product(_in_other_colours(room, [*there, *absent]), [f"absent colour+{kind}"])
    asked += product(parts, ["part"])
    asked = [(text, kind) for text, kind in asked if not engine.unknown_words(text)]
    answers = engine.run_many([text for text, _ in asked])
    said = [(text, kind, answer) for (text, kind), answer in zip(asked, answers, strict=True)]
    said += [(text, kind, run_phrase(engine, text).answer) for text, kind in _inside(room, engine)]
    return [_verdict(room, *one) for one in said]


@dataclass(frozen=True, eq=False)
class Showing:
    """A room with what was shown there: one thing of every name, by the vector of the name."""

    room: Room
    engine: QueryEngine
    shown: Mapping[bytes, TaughtWord]
    there: AbstractSet[bytes]  # vectors of everything that anything in the room is called by


def show_things(room: Room, engine: QueryEngine) -> Showing:
    shown: dict[bytes, TaughtWord] = {}
    for number, region in room.truth.regions.items():
        members = room.labels[-1] == number
        known = region.level == "whole" and region.thing and not engine.unknown_words(region.thing)
        if known and members.sum() >= MIN_GAUSSIANS:
            vector = engine.texts.of([region.thing]).tobytes()
            if vector not in shown:
                shown[vector] = engine.teach(region.thing, members, "whole")
    _, vectors = engine.texts.of_known(sorted(room.truth.words))
    return Showing(room, engine, shown, {vector.tobytes() for vector in vectors})


def ask_elsewhere(rooms: Sequence[Showing]) -> Iterator[Verdict]:
    """Everything that was shown in one room, asked of each other one."""
    for here, other in permutations(rooms, 2):
        for vector, word in here.shown.items():
            other.engine.taught = {word.key: word}
            kind = "shown" if vector in other.there else "absent shown"
            yield _verdict(other.room, word.name, kind, other.engine.run(word.name))


def _part_words(room: Room) -> tuple[list[str], list[str]]:
    """Words of parts that Gaussians of the room show, and such words that nothing in it is called by."""
    seen, counts = np.unique(room.labels, return_counts=True)
    shown = {int(number) for number, count in zip(seen, counts, strict=True) if count >= MIN_GAUSSIANS}
    parts = {item.word for key, item in room.truth.regions.items() if key in shown and _part(item)}
    return sorted(parts), sorted(_uncalled(PARTS, room.truth.words))


def _in_other_colours(room: Room, words: Sequence[str]) -> list[str]:
    """Every word with a colour that nothing of that name has."""
    rng, known = np.random.default_rng((room.seed, 13)), room.truth.words
    wrong = [[phrase for x in COLOURS if (phrase := f"{x} {word}") not in known] for word in words]
    return [str(rng.choice(phrases)) for phrases in wrong]


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
    """Platt scaling of all kinds of phrases. Raises as `fit_scaling` does."""
    fits = {  # the mean fit of a phrase with a colour tells nothing more
        kind: np.array([(*row.fits, row.common) for row in own])[:, : 3 if "colour" in kind else 4]
        for kind, own in grouped(rows, "kind").items()
    }
    return Calibration(**{name: fit_scaling(fits[one], fits[other]) for name, (one, other) in PAIRS.items()})


def verdict_table(rows: Sequence[Verdict]) -> str:
    """Markdown: what is accepted and rejected, and the area under the ROC curve, per tier; means over rooms
    with their standard deviation."""
    at = (f"accepted at {100 * share:.0f} % rejected" for share in SHARES)
    head = ("tier", "asked for", "phrases", "accepted %", "absent rejected %", "ROC area %", *at)
    lines = []
    for tier, own in grouped(rows, "tier").items():
        for name, pair in {**PAIRS, **SHOWN}.items():
            here = [row for row in own if row.kind in pair]
            if any(row.kind == pair[0] for row in here):
                rooms = grouped(here, "seed").values()
                columns = 100 * np.array([_shares(room, pair) for room in rooms]).T
                cells = [spread(column[np.isfinite(column)]) for column in columns]
                lines.append((tier, name, len(here), *cells))
    return markdown(head, lines)


def _shares(rows: Sequence[Verdict], pair: tuple[str, str]) -> tuple[float, ...]:
    """What is found and what is rejected, and how well scores tell them apart; NaN of nothing."""
    here = [[row for row in rows if row.kind == kind] for kind in pair]
    present, absent = (np.array([_score(row) for row in some]) for some in here)
    found, wrong = (float(np.mean([row.found for row in some])) if some else np.nan for some in here)
    compared = [np.nan] * (1 + len(SHARES))  # nothing to compare where one of both was not asked for
    if len(present) and len(absent):
        at = (np.mean(present > np.quantile(absent, share, method="higher")) for share in SHARES)
        compared = [separation(present, absent), *map(float, at)]
    return found, 1 - wrong, *compared


def _score(row: Verdict) -> float:
    """Value that a threshold would be put on."""
    if row.probability is not None:
        return row.probability
    return max(row.fits) if row.excess is None else row.excess


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
    lines = (
        (f"{p.low:g} to {p.high:g}", p.phrases, f"{100 * p.said:.0f}", f"{100 * p.there:.0f}")
        for p in curve(rows, asked)
    )
    return markdown((f"probability of a {asked} said", "phrases", "mean said %", "there %"), lines)


def chance_table(rows: Sequence[Verdict]) -> str:
    """Markdown: the share of phrases for nothing here that fit so well, beside what is said of them."""
    at_bar, slope = RULE.by_chance
    lines = [("said", "", *(f"{100 * sigmoid(logit(np.array(at_bar)) - slope * x):.1f}" for x in MARGINS))]
    for asked, (_, absent) in PAIRS.items():
        own = np.array([row.excess for row in rows if row.kind == absent and row.excess is not None])
        if len(own):
            lines.append((asked, str(len(own)), *(f"{100 * np.mean(own >= x):.1f}" for x in MARGINS)))
    return markdown(("absent %, by spreads above the bar", "phrases", *map(str, MARGINS)), lines)
