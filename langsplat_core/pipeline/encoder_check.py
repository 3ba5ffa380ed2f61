"""Test of an encoder on the bundled room: its geometry, the accuracy of its verdicts, and a calibration.

The regions of the room's tree are cut out of rendered images, as training cuts masks out of photographs, and
encoded. Their names are known (`assets/demo/names.json`), and so is what is present and what is absent.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

import numpy as np
from msgspec import Struct
from scipy.optimize import minimize

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import InputError
from langsplat_core.io.hostile import decode_json
from langsplat_core.io.scenes import load_scene
from langsplat_core.pipeline.language_field import field_of
from langsplat_core.progress import Progress, silent
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import PARTS, forms
from langsplat_core.query.rule import RULE
from langsplat_core.raster.render import splat_colours, view_of
from langsplat_core.scene import Calibration, CodebookCodec, PlattScaling, Scene, Tree
from langsplat_core.semantics.encoders import DEMO, Encoder
from langsplat_core.semantics.features import masked_crop
from langsplat_core.semantics.relevancy import bundled_vocabulary
from langsplat_core.training.language.merge_tree import SOLID

VIEWS = 16  # views of the room from which images are cut
IMAGES = (0, 1, 2)  # number per region, by level, from the views that show most of it
LEAST = 150  # px of the region that an image shows, at least
BATCH = 32  # images encoded between two reports of progress
MOST = 200  # most phrases of one kind that are asked
FOLDS = 5  # of cross-validation
ASKED = {  # fields of `Calibration`
    "thing": "things (sofa)",
    "part": "parts (armrest)",
    "inside": "parts of it (armrest of sofa)",
}

# Figure -> what it is; and what real CLIP has: ViT-B/16 in scenes (decoded by autoencoders that LangSplat was
# trained to), and ViT-B/32 on 500 photographs with 1 203 names of LVIS.
GEOMETRY: Mapping[str, tuple[str, tuple[str, str]]] = MappingProxyType({
    "own": ("best cosine of a name that is there, median", ("0.245 to 0.289", "0.257")),
    "other": ("best cosine of a name that is not, median", ("0.21 to 0.235", "")),
    "margin": ("own name less nearest canonical phrase, median", ("0.011 to 0.065", "")),
    "alike": ("images of two things: mean, 5 and 95 %", ("0.54 to 0.73", "0.57, 0.43, 0.73")),
    "hubness": ("deviation of the names' means", ("", "0.0088")),
    "best": ("best name less second best; its z", ("", "0.006, 4.1")),
})  # fmt: skip


@dataclass(frozen=True)
class Rates:
    """Shares of phrases of one kind that are found and rejected."""

    asked: str  # one of `ASKED`
    present: int
    absent: int
    found: float
    rejected: float
    # The same by a cross-validated calibration on the room; None where none can be fitted.
    calibrated: tuple[float, float] | None


@dataclass(frozen=True)
class EncoderReport:
    """Figures of an encoder in the bundled room."""

    encoder: str
    dim: int
    images: int
    phrases: int
    seconds: float
    geometry: dict[str, tuple[float, ...]]  # by the keys of `GEOMETRY`
    rates: tuple[Rates, ...]
    calibration: Calibration | None
    reason: str = ""  # why there is no calibration


class _Names(Struct):
    """Names of the bundled scene's regions, as assets/demo/names.json has them."""

    names: dict[int, list[str]]  # whole, or part with a word of its own -> its names
    called: list[str]  # all words for anything there


@dataclass(frozen=True, eq=False)
class NamedRoom:
    """The bundled room with the names of its things."""

    scene: Scene
    tree: Tree
    owners: Array  # (K,) the root that each node of the tree is in
    wholes: Mapping[int, Sequence[str]]  # node -> its names
    parts: Mapping[int, Sequence[str]]  # part with a word of its own -> its names
    called: frozenset[str]  # single words

    def has_not(self, phrase: str) -> bool:
        """Return whether no word of a phrase, in either number, is one for anything there."""
        return all(self.called.isdisjoint(forms(word)) for word in phrase.split())


def bundled_room() -> NamedRoom:
    """Read the bundled room."""
    folder = Path(str(files("langsplat_assets") / "demo"))
    stated = decode_json((folder / "names.json").read_bytes(), _Names, folder / "names.json")
    words = (form for phrase in stated.called for word in phrase.split() for form in forms(word))
    scene = load_scene(folder / "scene.ply")
    assert scene.language is not None
    assert scene.language.tree is not None
    tree = scene.language.tree
    owners = np.arange(tree.count)
    while (rising := tree.parents[owners] >= 0).any():
        owners[rising] = tree.parents[owners[rising]]
    parts, wholes = (
        {node: names for node, names in stated.names.items() if tree.levels[node] == level}
        for level in (1, 2)
    )
    return NamedRoom(scene, tree, owners, wholes, parts, frozenset(words))


def check_encoder(encoder: Encoder, progress: Progress = silent) -> EncoderReport:
    """Return the report of an encoder on the bundled room; encoding takes nearly all of the time."""
    start, room = time.perf_counter(), bundled_room()
    nodes, crops = room_images(room, encoder.image_size, progress)
    parts = []
    for first in range(0, len(crops), BATCH):
        progress("encoding images", first / len(crops))
        parts.append(encoder.encode_images(crops[first : first + BATCH]))
    images = np.concatenate(parts)
    progress("encoding names", 0.0)
    names = dict.fromkeys(name for own in room.wholes.values() for name in own)
    there = [name for name in names if not encoder.unknown_words(name)]
    plain = (name for name in bundled_vocabulary("things") if name.replace(" ", "").isalpha())
    absent = [name for name in filter(room.has_not, plain) if not encoder.unknown_words(name)]
    if min(len(there), len(absent)) < FEWEST:
        raise InputError(f"{encoder.id}: was taught too few words for things in the bundled room")
    engine = _engine(room, encoder, nodes, images)
    geometry = _geometry(room, engine, nodes, images, there, absent)
    rates, scalings, reason = [], {}, ""
    asked = _phrases(room, engine, there, absent)
    for done, (kind, texts) in enumerate(asked.items()):
        progress("asking", done / len(asked), ASKED[kind])
        fits, shares = zip(*(_answers(engine, some) for some in texts), strict=True)
        calibrated = None
        try:
            scalings[kind] = fit_scaling(*fits)
            calibrated = _cross_validated(*fits)
        except InputError as error:
            reason = reason or f"{kind}: {error}"
        found, wrong = shares
        rates.append(Rates(kind, len(fits[0]), len(fits[1]), found, 1 - wrong, calibrated))
    return EncoderReport(
        encoder=encoder.id,
        dim=encoder.dim,
        images=len(images),
        phrases=len(there) + len(absent),
        seconds=round(time.perf_counter() - start, 1),
        geometry=geometry,
        rates=tuple(rates),
        calibration=None if reason else Calibration(**scalings),
        reason=reason,
    )


def room_images(room: NamedRoom, side: int, progress: Progress = silent) -> tuple[Array, Array]:
    """Return (M,) nodes, and (M, side, side, 3) uint8 images of them, cut out of renderings."""
    scene, tree = room.scene, room.tree
    at = [tree.at(level) for level in range(3)]
    views = [view_of(scene, camera) for camera in scene.cameras[:: -(-len(scene.cameras) // VIEWS)]]
    shown = np.zeros((len(views), tree.count))  # px
    for row, view in zip(shown, views, strict=True):
        weights = view.contributions()
        for level in (1, 2):
            sums = np.bincount(at[level] + 1, weights, tree.count + 1)[1:]  # the first: in no node
            row += sums * (tree.levels == level)
    rank = np.argsort(np.argsort(-shown, axis=0), axis=0)
    wanted = (rank < np.take(IMAGES, tree.levels)) & (shown >= LEAST)
    nodes, images = [], []
    for number, view in enumerate(views):
        progress("rendering the bundled room", number / len(views))
        chosen = np.flatnonzero(wanted[number])
        members = np.stack([at[tree.levels[node]] == node for node in chosen], 1)
        drawn = splat_colours(view, scene.gaussians, members.astype(np.float32))
        image = (255 * drawn.colours.clip(0, 1) + 0.5).astype(np.uint8)
        for node, mask in zip(chosen.tolist(), np.moveaxis(drawn.values > SOLID, 2, 0), strict=True):
            if mask.sum() >= LEAST:
                nodes.append(node)
                images.append(masked_crop(image, mask, side))
    return np.array(nodes), np.stack(images)


def _engine(room: NamedRoom, encoder: Encoder, nodes: Array, images: Array) -> QueryEngine:
    """Return an engine on the room: regions have the mean vector of their images, subparts their part's."""
    kinds, row = np.unique(nodes, return_inverse=True)
    vectors = unit(np.stack([np.bincount(row, column) for column in images.T], 1)).astype(np.float32)
    number = np.full(room.tree.count + 1, -1)
    number[kinds] = np.arange(len(kinds))
    part, whole = (number[room.tree.at(level)] for level in (1, 2))
    part = np.where(part >= 0, part, whole)
    codes = np.stack([part, part, whole])[..., None]
    latents = codes.clip(0).astype(np.uint16), (codes[..., 0] >= 0).astype(np.float32)
    codec = CodebookCodec(vectors, np.zeros((len(vectors), 3), np.float32))
    field = replace(field_of(latents, codec, encoder, ()), tree=room.tree, calibration=None)
    return QueryEngine(replace(room.scene, language=field), lambda _: encoder)


def _geometry(
    room: NamedRoom,
    engine: QueryEngine,
    nodes: Array,
    images: Array,
    there: Sequence[str],
    absent: Sequence[str],
) -> dict[str, tuple[float, ...]]:
    """Return the figures of `GEOMETRY`."""
    words = engine.texts.of([*there, *absent])
    cosines = (images @ words.T).astype(np.float64)
    own, other = cosines[:, : len(there)], cosines[:, len(there) :]
    apart = room.owners[nodes][:, None] != room.owners[nodes]
    pairs = (images @ images.T)[apart]
    second, best = np.sort(cosines, axis=1)[:, -2:].T
    margins = own - (images @ engine.field.canonical.T).max(1, keepdims=True)
    figures = {
        "own": np.median(own.max(0)),
        "other": np.median(other.max(0)),
        "margin": np.median(margins.max(0)),
        "alike": [pairs.mean(), *np.quantile(pairs, (0.05, 0.95))],
        "hubness": cosines.mean(0).std(),
        "best": [np.median(best - second), np.median((best - cosines.mean(1)) / cosines.std(1))],
    }
    return {key: tuple(float(f"{x:.3g}") for x in np.atleast_1d(value)) for key, value in figures.items()}


def _phrases(
    room: NamedRoom, engine: QueryEngine, there: Sequence[str], absent: Sequence[str]
) -> dict[str, tuple[Sequence[str], Sequence[str]]]:
    """Return phrases for what is there and for what is not, by the keys of `ASKED`."""

    def known(words: set[str]) -> list[str]:
        return sorted(word for word in words if not engine.unknown_words(word))

    on: dict[str, set[str]] = {}  # a thing -> words of its parts
    for node, names in room.parts.items():
        for thing in room.wholes.get(int(room.owners[node]), ())[:1]:
            on.setdefault(thing, set()).update(names)
    parts = known(set().union(*on.values()))
    inside: tuple[list[str], list[str]] = [], []
    rng = np.random.default_rng(0)
    for thing in known(set(on)):
        has = sorted(on[thing].intersection(parts))
        lacks = [word for word in parts if on[thing].isdisjoint(forms(word))]
        for words, texts in zip((has, rng.permutation(lacks)[: len(has)].tolist()), inside, strict=True):
            texts += [f"{word} of the {thing}" for word in words]
    lacking = known(set(filter(room.has_not, PARTS)))
    return {"thing": (there, absent), "part": (parts, lacking), "inside": inside}


def _answers(engine: QueryEngine, texts: Sequence[str]) -> tuple[Array, float]:
    """Return the (n, 3) best fits per level of at most `MOST` phrases, and the share that was found."""
    asked = texts[:: -(-len(texts) // MOST) or 1]
    answers = (run_phrase(engine, text).answer for text in asked)  # a megabyte each
    rows = np.array([(*one.fits, one.found) for one in answers]).reshape(-1, 4)
    return rows[:, :3], float(rows[:, 3].mean()) if len(rows) else 0.0


def report_lines(report: EncoderReport) -> str:
    """Return a report for people."""
    yours = {key: ", ".join(f"{x:g}" for x in values) for key, values in report.geometry.items()}
    rows = [("geometry", "here", "real CLIP: in scenes", "on photographs")]
    rows += [(name, yours[key], *real) for key, (name, real) in GEOMETRY.items()]
    lines = [
        f"{report.encoder}, {report.dim} numbers: {report.images} images of the bundled room, "
        f"{report.phrases} names, {report.seconds:g} s\n",
        *(f"{a:<49}{b:<23}{c:<22}{d}".rstrip() for a, b, c, d in rows),
        f"\n{'verdicts on':<31}{'there: found':<20}{'not there: rejected':<23}both, with a calibration",
    ]
    for row in report.rates:
        fitted = "-" if row.calibrated is None else ", ".join(f"{100 * x:.0f} %" for x in row.calibrated)
        found = f"{100 * row.found:.0f} % of {row.present}"
        rejected = f"{100 * row.rejected:.0f} % of {row.absent}"
        lines.append(f"{ASKED[row.asked]:<31}{found:<20}{rejected:<23}{fitted}")
    said = "--calibrate keeps it for scenes of this encoder; it is from drawn rooms, and so marked"
    if report.encoder == DEMO:
        said = "this encoder has its own, from more rooms"
    lines += [
        f"\ncalibration: {said if report.calibration else f'none; {report.reason}'}",
        "here a region has one or two images, in a scene tens, and more is found; --json: to send this",
    ]
    return "\n".join(lines) + "\n"


# Platt scaling (Platt 1999) of fits, with Platt's smoothed targets.

FEWEST = 10  # least phrases of either kind that a calibration is fitted to
REJECTED = 0.95  # of what is absent, among the phrases that a calibration is fitted to


def fit_scaling(present: Array, absent: Array) -> PlattScaling:
    """Fit to (P, 3) fits of present phrases and (A, 3) of absent ones; both sets have the same weight.

    A fourth column, mean fits, counts too. InputError for fewer than ten of either, or fits not apart.
    """
    if min(len(present), len(absent)) < FEWEST:
        raise InputError("a calibration needs ten phrases for what is there and ten for what is not")
    fits = np.concatenate([present, absent])
    features = np.column_stack([fits[:, 2], fits[:, :2].max(axis=1), fits[:, 3:]])
    there, not_there = counts = len(present), len(absent)
    targets = np.repeat([(there + 1) / (there + 2), 1 / (not_there + 2)], counts)
    weights = np.repeat([1 / there, 1 / not_there], counts)

    def loss(parameters: Array) -> float:
        logits = parameters[0] + features @ parameters[1:]
        return float((weights * (np.logaddexp(0, logits) - targets * logits)).sum())

    start = np.eye(1, 1 + features.shape[1], 1)[0]
    constant, whole, finer, *common = minimize(loss, start, method="BFGS").x.round(3).tolist()
    if whole + finer <= 0:
        raise InputError("what is there has no larger fits than what is not: nothing to calibrate")
    plain = PlattScaling(constant, whole, finer, common=sum(common, 0.0))
    highest = float(np.quantile(_probabilities(plain, absent), REJECTED, method="higher"))
    return replace(plain, found=float(np.ceil(1000 * max(highest, RULE.weak_probability)) / 1000))


def _probabilities(scaling: PlattScaling, fits: Array) -> Array:
    return np.array([scaling.probability((m[0], m[1], m[2]), sum(m[3:])) for m in fits.tolist()])


def _cross_validated(present: Array, absent: Array) -> tuple[float, float]:
    """Return the shares found and rejected, each fold of phrases judged by a fit to the others."""
    found: tuple[list[Array], list[Array]] = [], []
    for fold in range(FOLDS):
        own = [np.arange(len(fits)) % FOLDS == fold for fits in (present, absent)]
        scaling = fit_scaling(present[~own[0]], absent[~own[1]])
        for some, fits, chosen in zip(found, (present, absent), own, strict=True):
            some.append(_probabilities(scaling, fits[chosen]) >= scaling.found)
    right, wrong = (float(np.concatenate(some).mean()) for some in found)
    return right, 1 - wrong
