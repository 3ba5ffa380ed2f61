"""Evidence of an answer: the photographs that show it, with the mask of each that overlaps most with it.

A wrong mask hides in a region's features, a mean as sure of three photographs as of thirty. So every
photograph is one vote, for the region if it has a mask of just that region, and the share of votes has a beta
distribution. A wrong vote shows in the fit of the phrase to its mask.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os.path import exists
from pathlib import Path

import numpy as np
import scipy
from PIL import Image, ImageDraw, ImageFont, ImageOps

from langsplat_core.arrays import Array
from langsplat_core.config import DatasetConfig
from langsplat_core.errors import FormatError, InputError, report_loss, shortened
from langsplat_core.io.cameras import SUFFIX as CAMERAS
from langsplat_core.io.cameras import read_cameras
from langsplat_core.pipeline.report import PREVIEW, REPORT, stated_figures, work_folder
from langsplat_core.progress import Progress, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.render import view_of
from langsplat_core.scene import LEVELS, NO_NODE, Camera, Scene
from langsplat_core.scene.surface import SMALLEST
from langsplat_core.semantics.features import FeatureStore, ImageFeatures
from langsplat_core.training.language.lift import SHOWN, VOTE
from langsplat_core.training.language.merge_tree import SOLID


@dataclass(frozen=True)
class Vote:
    """A photograph that shows an answer, and its mask that overlaps most with it."""

    view: int  # index into the scene's cameras
    photograph: str  # name of that camera
    pixels: int  # number of the photograph's pixels that show the answer
    mask: int  # row of the photograph's features; -1 where no mask touches the answer
    overlap: float  # intersection over union of the mask and the answer as rendered, in [0, 1]
    cosine: float | None  # of the mask's vector with the phrase; None without a mask
    fit: float | None  # the same in spreads above chance, see `QueryEngine.compare`

    @property
    def agrees(self) -> bool:
        """True for a vote for the answer: the mask is of just the answer."""
        return self.overlap >= VOTE


@dataclass(frozen=True, eq=False)
class Evidence:
    """The photographs that show the best region of an answer."""

    phrase: str  # phrase that masks are compared with: for "handle of the mug", "handle"
    node: int  # of the scene's tree
    members: Array  # (N,) bool Gaussians of the answer in that node
    votes: tuple[Vote, ...]  # for the answer, the best fit first
    others: tuple[Vote, ...]  # against the answer, those that show most of it first

    @property
    def share(self) -> float:
        """Mean of the distribution Beta(1 + votes for, 1 + votes against), in (0, 1)."""
        return (1 + len(self.votes)) / (2 + len(self.votes) + len(self.others))

    @property
    def fitting(self) -> int:
        """Count of the votes for the answer whose mask fits the phrase better than by chance."""
        return sum(vote.fit is not None and vote.fit > 0 for vote in self.votes)

    @property
    def interval(self) -> tuple[float, float]:
        """The 5 % and 95 % quantiles of the same distribution."""
        low, high = scipy.special.betaincinv(1 + len(self.votes), 1 + len(self.others), (0.05, 0.95))
        return float(low), float(high)

    def __str__(self) -> str:
        low, high = (100 * edge for edge in self.interval)
        seen = len(self.votes) + len(self.others)
        share = f"outlined in {len(self.votes)} of {seen} photographs that show it"
        return f"{share} (90 %: {low:.0f} to {high:.0f} %), {self.fitting} of these fit the phrase"


def find_evidence(
    engine: QueryEngine,
    answer: QueryResult,
    phrases: Sequence[str],
    features: Sequence[ImageFeatures],
    progress: Progress = silent,
) -> Evidence | None:
    """Return the evidence of the best region of `answer`; None where no region answers.

    phrases: the one that fits best is compared with masks; FormatError for features of another scene.
    """
    scene, found = engine.scene, _best_region(engine, answer)
    if found is None:
        return None
    size, votes = engine.field.codec.vector_dim, []
    phrase, place = phrases[0], (answer.level, found[1])
    if len(phrases) > 1:
        phrase = max(phrases, key=lambda one: float(engine.run(one).relevancy[place].mean()))
    for view, camera in enumerate(scene.cameras):
        progress("comparing photographs", view / len(scene.cameras))
        seen = features[view]
        if seen.labels.shape[1:] != (camera.height, camera.width) or seen.vectors.shape[1] != size:
            what = f"{camera.width}x{camera.height} pixels and vectors of {size} numbers"
            remedy = "name this scene's own folder with --work"
            raise FormatError(f"the masks of {camera.name!r} are of another scene, not of {what}; {remedy}")
        shown = _shown(scene, view, found[1])
        if shown.sum() >= SHOWN:
            mask, overlap = _nearest(seen, shown)
            cosine = fit = None
            if mask >= 0:
                cosines, fits = engine.compare(phrase, seen.vectors[[mask]], answer.level)
                cosine, fit = float(cosines[0]), float(fits[0])
            votes.append(Vote(view, camera.name, int(shown.sum()), mask, overlap, cosine, fit))
    progress("comparing photographs", 1.0)
    agreeing = sorted((vote for vote in votes if vote.agrees), key=lambda vote: -(vote.fit or 0.0))
    others = sorted((vote for vote in votes if not vote.agrees), key=lambda vote: -vote.pixels)
    return Evidence(phrase, *found, tuple(agreeing), tuple(others))


def _best_region(engine: QueryEngine, answer: QueryResult) -> tuple[int, Array] | None:
    """Return the node of an answer's best region, and the answer's (N,) bool members in it."""
    at = engine.tree.at(answer.level)
    inside = answer.members & (at != NO_NODE)
    if not inside.any():
        return None
    nodes, row, counts = np.unique(at[inside], return_inverse=True, return_counts=True)
    relevancies = np.bincount(row, answer.even[inside]) / counts
    best = int(nodes[np.lexsort((relevancies, counts >= SMALLEST))[-1]])
    return best, inside & (at == best)


def _shown(scene: Scene, view: int, members: Array) -> Array:
    """Return (H, W) bool pixels of a view of which the Gaussians `members` make more than half."""
    drawn = view_of(scene, scene.cameras[view])
    return np.asarray(drawn.splat(members[:, None].astype(np.float32))[0][..., 0] > SOLID)


def _nearest(seen: ImageFeatures, shown: Array) -> tuple[int, float]:
    """Return the mask, of any level, that overlaps most with `shown` (H, W), or -1, and its overlap."""
    count = len(seen.vectors)
    overlaps = np.zeros(count)
    for labels in seen.labels:
        shared = np.bincount(labels[shown & (labels >= 0)], minlength=count)
        areas = np.bincount(labels[labels >= 0], minlength=count)
        overlaps = np.maximum(overlaps, shared / (areas + shown.sum() - shared))
    if not overlaps.any():
        return -1, 0.0
    return int(overlaps.argmax()), float(overlaps.max())


# What training kept beside a scene.

SAME = 1e-3  # of a rotation matrix's entries: between cameras of one training, written and read again


def kept_features(path: Path, scene: Scene, work: Path | None = None) -> Sequence[ImageFeatures]:
    """Return masks and vectors of a scene's photographs, from `work` or beside it; InputError without."""
    store = FeatureStore((work or work_folder(path)) / "features")
    missing = [camera.name for camera in scene.cameras if not exists(store.path(camera.name))]
    if missing or not scene.cameras:
        what = f"no masks of {missing[0]!r}" if scene.cameras and exists(store.folder) else "no such folder"
        need = "evidence needs the masks that `langsplat train` keeps: train it, or name their folder: --work"
        raise InputError(f"{store.folder}: {what}; {need}")
    trained = store.folder.with_name(PREVIEW).with_suffix(CAMERAS)
    if exists(trained) and not _alike(scene.cameras, read_cameras(trained)):
        raise InputError(f"{trained}: cameras of another scene; name this one's own folder with --work")
    return store.of([camera.name for camera in scene.cameras])


def _alike(cameras: Sequence[Camera], trained: Sequence[Camera]) -> bool:
    """Return whether cameras may be those of a training, of a scene moved, turned or scaled since."""
    known = {camera.name: camera.rotation for camera in trained}
    turns = [camera.rotation.T @ known[camera.name] for camera in cameras if camera.name in known]
    return bool(turns) and bool(np.ptp(turns, 0).max() < SAME)  # one and the same for all


def kept_photographs(
    path: Path,
    scene: Scene,
    work: Path | None = None,
    dataset: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Array]:
    """Return photographs by the name of their camera, (H, W, 3) uint8 as training saw them.

    From `dataset`, or from where the report of the training says; InputError where some are not those.
    """
    from langsplat_core.datasets import load_photographs
    from langsplat_core.datasets.photos import content, photo_folder
    from langsplat_core.datasets.workspace import MATCHES

    if not scene.cameras:
        raise InputError(f"{path}: has no cameras, which photographs belong to; keep .cameras.json beside it")
    work = work or work_folder(path)
    stated = stated_figures(work / REPORT)
    place, known = dataset or stated.get("dataset"), stated.get("contents")
    trained = known if isinstance(known, dict) else {}
    if not isinstance(place, str | Path) or not str(place) or not (dataset or exists(place)):
        where = f"not in {place}" if isinstance(place, str) and place else f"not named in {work / REPORT}"
        raise InputError(f"{path}: its photographs are {where}; name their folder with --photographs")
    other: list[str] = []
    if not dataset and any(work.glob(f"sfm-*/{MATCHES}")):  # else other photographs are located first
        here = {content(photo)[:16] for photo in photo_folder(Path(place))[1]}
        other = [name for name, content in trained.items() if here and content not in here]
    if not other:
        most = max(max(camera.width, camera.height) for camera in scene.cameras)
        config = DatasetConfig(max_side=most, allow_few_cameras=True)
        capture = load_photographs(Path(place), config, work, progress)
        now = capture.contents().items()
        other = [name for name, content in now if trained.get(name, content) != content]
    if other:
        said = "not the files that were trained on, so that masks may be of something else"
        said = f"{place}: {said}: {shortened(other)}"
        if not dataset:  # others may be copies, of other sizes for example
            raise InputError(f"{said}; train again, or name a folder of the earlier ones with --photographs")
        report_loss("%s", said)
    found = {camera.name: image for camera, image in zip(capture.cameras, capture.images, strict=True)}
    photographs = {}
    for camera in scene.cameras:
        if camera.name not in found:
            raise InputError(f"{place}: has no photograph {camera.name!r}; name another with --photographs")
        image = found[camera.name]
        if image.shape[:2] != (camera.height, camera.width):  # rounded otherwise
            image = np.asarray(Image.fromarray(image).resize((camera.width, camera.height)))
        photographs[camera.name] = image
    return photographs


# A contact sheet.

FEW = 5  # photographs in a row
SIDE, GAP, LINE = 200, 10, 16  # px: of a thumbnail, between them, from line to line
LEAST = 48  # px of the photograph that a thumbnail shows at least
PAPER, INK, MASK, ANSWER = (255, 255, 255), (30, 30, 30), (255, 210, 0), (0, 200, 255)


def draw_evidence(
    evidence: Evidence,
    answer: QueryResult,
    scene: Scene,
    features: Sequence[ImageFeatures],
    photographs: Mapping[str, Array],
) -> Array:
    """Return an (H, W, 3) uint8 contact sheet: the best votes, the worst ones, those against the answer."""
    rows = {"best votes": evidence.votes[:FEW]}
    rows["worst votes"] = evidence.votes[FEW:][-FEW:]
    rows["shown without a mask of just that"] = evidence.others[:FEW]
    kept = {title: votes for title, votes in rows.items() if votes}
    step = SIDE + 5 * LINE
    sheet = Image.new("RGB", (GAP + FEW * (SIDE + GAP), 3 * LINE + len(kept) * step), PAPER)
    brush, font = ImageDraw.Draw(sheet), ImageFont.load_default(13)
    heading = f"{answer.phrase}: {answer.verdict}, {LEVELS[answer.level]}; {evidence}"
    brush.text((GAP, GAP), heading, INK, ImageFont.load_default(16))
    legend = "yellow: the mask that overlaps most; blue: the answer as rendered"
    brush.text((sheet.width - GAP, 2 * LINE), legend, INK, font, anchor="ra")
    for row, (title, votes) in enumerate(kept.items()):
        top = 3 * LINE + row * step
        brush.text((GAP, top), title, INK, font)
        for column, vote in enumerate(votes):
            shown = _shown(scene, vote.view, evidence.members)
            mask = (features[vote.view].labels == vote.mask).any(0) & (vote.mask >= 0)
            left = GAP + column * (SIDE + GAP)
            thumbnail = _thumbnail(photographs[vote.photograph], mask, shown)
            sheet.paste(thumbnail, (left, top + LINE + 2))
            says = "no mask" if vote.cosine is None else f"cosine {vote.cosine:.3f}, fit {vote.fit:+.2f}"
            caption = f"{vote.photograph[:24]}\n{says}\noverlap {vote.overlap:.2f}"
            brush.text((left, top + LINE + SIDE + 4), caption, INK, font, spacing=2)
    return np.asarray(sheet)


def _thumbnail(photograph: Array, mask: Array, shown: Array) -> Image.Image:
    """Return the part of a photograph around mask and answer, with both outlined, in a square."""
    rows, columns = np.nonzero(mask | shown)
    extent = max(np.ptp(rows), np.ptp(columns)) + 1
    around = round(max(0.3 * extent, (LEAST - extent) / 2))
    top, left = max(rows.min() - around, 0), max(columns.min() - around, 0)
    part = np.s_[top : rows.max() + 1 + around, left : columns.max() + 1 + around]
    square = Image.fromarray(np.ascontiguousarray(photograph[part]))
    image = np.array(ImageOps.pad(square, (SIDE, SIDE), Image.Resampling.BICUBIC, PAPER))
    for region, colour in ((shown, ANSWER), (mask, MASK)):
        cut = ImageOps.pad(Image.fromarray(region[part]), (SIDE, SIDE), Image.Resampling.NEAREST)
        inside = np.asarray(cut)
        image[inside & ~scipy.ndimage.binary_erosion(inside, iterations=2, border_value=1)] = colour
    return Image.fromarray(image)
