"""Reports on language fields.

* lifting: methods from masks to answers in rooms with known truth: LERF's, the paper's with and without its
  autoencoder, its training from both starts, lifted CLIP vectors behind every codec, and ours with one part
  taken out, all with the same Gaussians, outlines and encoder;
* colours: how far apart the latent colours of neighbours are to the eye.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from skimage.color import deltaE_ciede2000, rgb2lab

from langsplat_core.arrays import Array, unit
from langsplat_core.config import (
    AutoencoderConfig,
    CodebookConfig,
    Count,
    LiftConfig,
    LinearConfig,
    PictureConfig,
)
from langsplat_core.display.displays import latent_colours
from langsplat_core.errors import FormatError, InputError
from langsplat_core.extensions.benchmarks.measure import markdown
from langsplat_core.io.scenes import load_scene
from langsplat_core.progress import Progress, silent
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.protocol import LiftingRasterizer, View
from langsplat_core.scene import LEVELS, NO_NODE, Camera, Gaussians, Scene
from langsplat_core.scene.surface import build_surface
from langsplat_core.semantics.relevancy import relevancy
from langsplat_core.semantics.store import ImageEncoder, masked_crop
from langsplat_core.training.language.codec_fit import CodecReport
from langsplat_core.training.language.palette import FEWEST_LINKS, LEAST
from tests.benchmarks.room import HOLD_OUT, InRooms, MaskOrigin, Room, Variant, median_seconds, publish
from tests.benchmarks.scoring import (
    Answer,
    DirectScore,
    Measured,
    Score,
    ask,
    grouped,
    loss_cells,
    masks_of_maps,
    of_kind,
)

PATCHES = "LERF's method: patches at seven scales, no masks"
OURS = "ours"
KINDS = ("object", "part", "subpart", "all")


@dataclass(frozen=True)
class Lifting(InRooms):
    """LERF's method, the paper's with and without its autoencoder, every codec and ours, in rooms with known
    truth: accuracy in images and among Gaussians, relevancy error, bytes, seconds. Hours; every row is kept
    as it is made."""

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
        first = [row for row in rows if row.measured.masks in (self.masks[0], "tiles")]
        publish(self, "lifting", "From masks to answers", method_table(rows), rows, partial(plot, first))


@dataclass(frozen=True)
class MethodRow:
    """One method in one room."""

    seed: int
    measured: Measured

    @property
    def image_ms(self) -> float:
        """Milliseconds from a new phrase to one image. The paper and LERF have no answer before the image."""
        own = self.measured.query == "blend answers" and self.measured.name != PATCHES
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
        changed["squares in place of masks"] = {"masks": "tiles"}
    return [
        ours,
        *(replace(paper, name=name, **parts) for name, parts in theirs.items()),
        *(replace(ours, name=f"{OURS}, {name}", **parts) for name, parts in changed.items()),
        Variant(PATCHES, masks),
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
    base |= {name: getattr(config, name) for name in ("views", "size", "steps", "cut")}
    base |= {name: getattr(command, name) for name in ("codec_steps", "gradient_steps")}
    for variant in chosen:
        made = by_patches if variant.name == PATCHES else partial(Room.measure, fresh=True)
        key = base | {"masks": variant.masks, "method": variant.name}
        yield MethodRow(room.seed, kept.row(key, partial(made, room, variant)))


def by_patches(room: Room, variant: Variant) -> Measured:
    """Ask the phrases of vectors of patches; they are encoded by our own field's engine."""
    train, _ = room.capture.split(HOLD_OUT)
    views = [(room.capture.cameras[i], room.capture.images[i]) for i in train]
    vectors = lift_patches(load_lifting_rasterizer("cpu"), room.gaussians, views, room.encoder, room.progress)
    engine = room.engine(replace(variant, name=OURS))
    patches = PatchField(vectors, engine.field.canonical, engine.field.reading.temperature)
    asked = ask(engine, room.texts)
    asked = replace(asked, answers=reread(asked.answers, patches))
    one = np.stack([answer.vector for answer in list(asked.answers.values())[:1]])

    def picture() -> Array:
        return pictures(patches, CpuRasterizer().view(room.gaussians, room.held_out[0]), one)

    def judge(view: View, answers: Sequence[Answer]) -> Iterator[tuple[Array, tuple[int, int]]]:
        if answers:
            maps = pictures(patches, view, np.stack([answer.vector for answer in answers]))
            yield from masks_of_maps(maps)

    measured = room.measure_asked(asked, variant, judge)
    return replace(
        measured,
        codec=f"{vectors.shape[2]} numbers at {len(vectors)} scales",
        bytes_per_gaussian=vectors.nbytes / max(vectors.shape[1], 1),
        frame_ms=1000 * median_seconds(picture),
    )


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


def plot(rows: Sequence[MethodRow], path: Path) -> None:
    """Accuracy in images and among Gaussians against the time from a phrase to an image; means over rooms,
    with bars of one standard deviation."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, 2, figsize=(10, 5.6), layout="constrained", sharex=True)
    own = grouped(rows, "measured.name")
    for panel, (title, column) in zip(panels, (("mIoU in images %", 1), ("IoU in 3D %", 3)), strict=True):
        for number, (name, same) in enumerate(own.items(), 1):
            shares = np.array([100 * of_kind(row.measured, "all")[column] for row in same])
            at = float(np.mean([row.image_ms for row in same])), float(shares.mean())
            colour = "#0072b2" if name.startswith(OURS) else "#d55e00"
            # Methods that are equally fast stand above each other: their numbers go to both sides in turn.
            side = 1 if number % 2 else -1
            panel.errorbar(*at, yerr=shares.std(), fmt="o", color=colour, capsize=2)
            style = {"ha": "left" if side > 0 else "right", "va": "center", "textcoords": "offset points"}
            panel.annotate(str(number), at, (7 * side, 0), fontsize=9, **style)
        panel.set(xscale="log", xlabel="milliseconds from a phrase to its image", ylabel=title)
        panel.grid(alpha=0.3)
    legend = [pyplot.Line2D([], [], linestyle="", label=f"{k}  {name}") for k, name in enumerate(own, 1)]
    figure.legend(
        handles=legend, loc="outside lower center", ncols=2, fontsize=8, handlelength=0, frameon=False
    )
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


# LERF's method, without masks: CLIP vectors of square patches at several scales, and a search of the scale
# that fits the phrase best (Kerr et al. 2023, sections 3.1 and 3.3). LERF trains a field of vectors over
# position and scale; here they are averaged onto Gaussians that are there, `W^T y / W^T 1` at every scale.

SCALES = tuple(float(scale) for scale in np.linspace(0.05, 0.5, 7))  # LERF's; it interpolates between them
OVERLAP = 0.5  # of neighbouring patches
CHANNELS = 32  # of a picture of vectors that are splatted or gathered at a time


@dataclass(frozen=True, eq=False)
class PatchField:
    """CLIP vectors of Gaussians at every scale."""

    vectors: Array  # (S, N, D) float32 unit; zero where never seen
    canonical: Array  # (C, D) float32 unit
    temperature: float


def patch_vectors(image: Array, encoder: ImageEncoder, scale: float) -> Array:
    """(H, W, D) float32 vectors of an image (H, W, 3) uint8: of square patches `scale` high, interpolated
    between their centres."""
    height, width = image.shape[:2]
    side = min(max(round(scale * height), 2), height, width)
    rows, columns = _starts(height, side), _starts(width, side)
    whole, size = np.ones((side, side), bool), encoder.image_size
    crops = [masked_crop(image[y : y + side, x : x + side], whole, size) for y in rows for x in columns]
    vectors = encoder.encode_images(np.stack(crops)).reshape(len(rows), len(columns), -1)
    down = _between(vectors, rows + (side - 1) / 2, height)
    return np.asarray(_between(down.swapaxes(0, 1), columns + (side - 1) / 2, width).swapaxes(0, 1))


def _between(values: Array, centres: Array, length: int) -> Array:
    """(K, ...) values at K rising `centres` -> (length, ...) at every whole pixel, linear in between and
    constant beyond the ends."""
    at = np.interp(np.arange(length), centres, np.arange(len(centres)))
    low = np.minimum(at.astype(int), len(centres) - 1)
    high = np.minimum(low + 1, len(centres) - 1)
    share = (at - low).astype(np.float32).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[low] + share * (values[high] - values[low]))


def _starts(length: int, side: int) -> Array:
    """Where patches of `side` pixels begin, so that they cover `length` and overlap by `OVERLAP`."""
    count = int(np.ceil((length - side) / (side * (1 - OVERLAP)))) + 1
    return np.linspace(0, length - side, count).round().astype(int)


def lift_patches(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, Array]],
    encoder: ImageEncoder,
    progress: Progress = silent,
) -> Array:
    """(S, N, D) unit vectors of Gaussians from views (camera, image (H, W, 3) uint8)."""
    total: Array | None = None
    for done, (camera, image) in enumerate(views):
        view = rasterizer.view(gaussians, camera)
        for row, scale in enumerate(SCALES):
            vectors = patch_vectors(image, encoder, scale)
            if total is None:
                total = np.zeros((len(SCALES), len(gaussians), vectors.shape[2]), np.float32)
            for part in _parts(vectors.shape[2]):
                total[row, :, part] += view.gather(np.ascontiguousarray(vectors[..., part]))
        progress("patches of the photographs", (done + 1) / len(views))
    assert total is not None  # there are views
    return np.stack([unit(sums).astype(np.float32) for sums in total])


def _parts(count: int) -> Iterator[slice]:
    return (slice(start, min(start + CHANNELS, count)) for start in range(0, count, CHANNELS))


def pictures(field: PatchField, view: View, phrases: Array) -> Array:
    """(Q, D) unit phrase vectors -> (Q, H, W) relevancy in a view, each at its best scale: the one with the
    highest relevancy in the picture."""
    best: Array | None = None
    gate = PictureConfig().alpha_gate
    for vectors in field.vectors:
        blended = [view.splat(np.ascontiguousarray(vectors[:, part])) for part in _parts(vectors.shape[1])]
        shown, alpha = np.concatenate([values for values, _ in blended], 2), blended[0][1]
        flat = unit(shown.reshape(-1, shown.shape[2]))
        values = relevancy(flat, phrases, field.canonical, field.temperature).astype(np.float32)
        maps = np.where(alpha > gate, np.moveaxis(values.reshape(*alpha.shape, -1), 2, 0), 0)
        if best is not None:
            higher = maps.max((1, 2), keepdims=True) > best.max((1, 2), keepdims=True)
            maps = np.where(higher, maps, best)
        best = maps
    assert best is not None  # there are scales
    return best


def among_gaussians(field: PatchField, phrases: Array) -> Array:
    """(Q, D) unit phrase vectors -> (Q, N) float32 relevancy, each phrase at its best scale."""
    best = np.zeros((len(phrases), field.vectors.shape[1]), np.float32)
    for vectors in field.vectors:
        values = relevancy(vectors, phrases, field.canonical, field.temperature).T
        values[:, ~vectors.any(axis=1)] = 0
        better = values.max(axis=1) > best.max(axis=1)
        best[better] = values[better]
    return best


def reread(answers: Mapping[str, Answer], field: PatchField) -> dict[str, Answer]:
    """The answers to the same phrases by patches."""
    phrases = np.reshape([answer.vector for answer in answers.values()], (-1, field.vectors.shape[2]))
    found = {}
    for name, values in zip(answers, among_gaussians(field, phrases), strict=True):
        seen = values[values > 0]
        median = float(np.median(seen)) if len(seen) else 0.0
        peak = float(values.max())
        found[name] = replace(answers[name], values=values, even=values, peak=peak, median=median)
    return found


# Latent colours of things that lie side by side: how far apart they are to the eye.

SHARES = (0.0, 0.1, 0.25, 0.5)  # quantiles that are stated


@dataclass(frozen=True)
class Colours:
    """CIEDE2000 differences between the mean latent colours of neighbouring nodes of scenes."""

    scenes: tyro.conf.Positional[tuple[Path, ...]]

    def run(self) -> None:
        head = ("scene", "level", "neighbours", "smallest", "10 %", "25 %", "median")
        rows = []
        for path in self.scenes:
            scene = load_scene(path)
            if scene.language is None or scene.language.tree is None:
                raise InputError(
                    f"{path}: has no language field with a tree; train one, or choose another scene"
                )
            for level in range(len(LEVELS)):
                found = differences(scene, level)
                stated = np.quantile(found, SHARES) if len(found) else np.full(len(SHARES), np.nan)
                rows.append((path.parent.name, LEVELS[level], str(len(found)), *(f"{v:.1f}" for v in stated)))
        print(markdown(head, rows))


def differences(scene: Scene, level: int) -> Array:
    """(P,) of the pairs of neighbouring nodes at a level."""
    field = scene.language
    assert field is not None
    assert field.tree is not None
    node, surface = field.tree.at(level), build_surface(scene.gaussians)
    names, number, sizes = np.unique(node, return_inverse=True, return_counts=True)
    colours = latent_colours(field)[level].astype(np.float64)
    means = np.stack([np.bincount(number, colours[:, k]) / sizes for k in range(3)], 1)
    ends = np.sort(np.stack([number[surface.rows[end]] for end in surface.ends]), axis=0)
    pairs, links = np.unique(ends[:, ends[0] != ends[1]], axis=1, return_counts=True)
    counted = (names[pairs] != NO_NODE).all(0) & (sizes[pairs] >= LEAST).all(0) & (links >= FEWEST_LINKS)
    first, second = (rgb2lab(means[one]) for one in pairs[:, counted])
    return np.asarray(deltaE_ciede2000(first, second))
