"""The report `scale`: time and memory of this project at large sizes, and whether memory grows.

* load: a large PLY, read by this program and by plyfile, into the same five arrays. The file has just been
  written, so it is in the system's cache.
* moving: the coarse images that the viewer draws while the camera moves, beside their distance from the full
  one.
* endurance: one process, a scene made large, large images and many phrases.

The report `formats`: what writing a scene in each format and reading it back changes.

Loading runs in fresh interpreters (`fresh`), whose peak memory is that of everything in them.
"""

import itertools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import mean, median
from typing import Any, Literal, get_args

import numpy as np
import tyro
from PIL import Image

from langsplat_core.arrays import Array, psnr, sigmoid, unit
from langsplat_core.cli.arguments import OutFolder
from langsplat_core.config import Count, CountOrZero, PictureConfig
from langsplat_core.display.composing import compose_upwards
from langsplat_core.display.displays import Channels
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.raster_speed import Size, peak_memory, resident_memory, restart_peak
from langsplat_core.extensions.benchmarks.report import markdown
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import formats, load_scene, save_scene
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.query.engine import QueryEngine, TextEncoder, no_field
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.render import render, splat_colours
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import merged
from langsplat_core.scene.transform import C0
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.relevancy import bundled_vocabulary
from tests.benchmarks.fresh import in_fresh_interpreter
from tests.benchmarks.room import publish
from tests.support.scenes import repeated

COARSE = ((1.0, False), (0.5, False), (0.25, False), (0.5, True), (0.25, True))  # resolution, whether merged
PARTS = 4  # that phrases and images are measured in: what grows is seen from one to the next
Part = Literal["load", "moving", "endurance"]


@dataclass(frozen=True)
class Scale:
    """Loading, images while the camera moves and a long session at large sizes: time and memory.
    Half an hour and 8 GB as it stands."""

    scene: tyro.conf.Positional[Path] = Path("assets/demo/scene.ply")
    """A scene with a language field, and its cameras beside it, for moving and endurance."""
    only: tuple[Part, ...] = get_args(Part)
    """Parts to measure."""
    rows: Count = 2_500_000
    """load: Gaussians in the file, which takes 248 bytes each in the temporary folder while it runs."""
    repeats: Count = 3
    """load: readings with each program; the fastest counts."""
    moving: CountOrZero = 500_000
    """moving: Gaussians; the scene's are repeated, each beside itself. 0: as they are."""
    moving_size: Size = (1280, 800)
    """moving: width and height of the full image, pixels."""
    views: Count = 12
    """moving: cameras of the scene, evenly chosen."""
    count: Count = 5_000_000
    """endurance: Gaussians; the scene's are repeated until there are so many."""
    size: Size = (7680, 4320)
    """endurance: width and height of the images, pixels."""
    images: Count = 8
    """endurance: images that are drawn behind the first one."""
    phrases: Count = 1_000
    """endurance: phrases that are asked, one after the other; none twice."""
    out: OutFolder = Path("bench_out")
    """Folder for scale.md and scale.json."""

    def run(self) -> None:
        with TerminalProgress() as progress:
            done = {part: REPORTS[part][0](self, progress) for part in self.only}
        text = "\n".join(f"## {part}\n\n{REPORTS[part][1](rows)}" for part, rows in done.items())
        publish(self, "scale", "Large sizes", text, [row for rows in done.values() for row in rows])


def open_scene(path: Path) -> Scene:
    """A scene with a language field and cameras; InputError for any other."""
    scene = load_scene(path)
    if scene.language is None or not scene.cameras:
        reason = no_field(scene) if scene.language is None else "it has no cameras beside it"
        raise InputError(f"{path}: {reason}")
    return scene


@dataclass(frozen=True)
class Loading:
    reader: str
    rows: int
    file_bytes: int
    seconds: float  # the least of several: other programs only ever add to it
    kept_bytes: int  # of the arrays that remain
    peak_bytes: int | None  # greatest resident memory of the process; None where the system does not tell
    same: bool  # whether the arrays are those that "langsplat" read


def measure_loading(command: Scale, progress: Progress = silent) -> list[Loading]:
    """Write a binary PLY of degree 3 to a temporary folder, read it with both readers, and remove it."""
    runs: dict[str, list[dict[str, Any]]] = {"langsplat": [], "plyfile": []}
    with tempfile.TemporaryDirectory(prefix="langsplat_load_") as folder:
        path, random = Path(folder) / "scene.ply", np.random.default_rng(0).standard_normal
        shapes = [(command.rows, *each) for each in ((3,), (3,), (4,), (), (16, 3))]
        write_ply(path, Gaussians(*(random(shape, np.float32) for shape in shapes)))
        size = path.stat().st_size
        turns = list(itertools.product(range(command.repeats), runs))
        for done, (_, reader) in enumerate(turns):
            progress(f"reading with {reader}", done / len(turns))
            runs[reader].append(in_fresh_interpreter(reader, path))
    right = runs["langsplat"][0]["digest"]
    return [
        Loading(
            reader, command.rows, size, min(run["seconds"] for run in found), found[0]["kept_bytes"],
            max((run["peak_bytes"] for run in found if run["peak_bytes"]), default=None),
            all(run["digest"] == right for run in found),
        )
        for reader, found in runs.items()
    ]  # fmt: skip


def load_table(loadings: Sequence[Loading]) -> str:
    """Markdown; ratios are to "langsplat"."""
    first = loadings[0]
    lines = (
        (row.reader, f"{row.seconds:.3f}", f"{row.seconds / first.seconds:.1f}", _gb(row.kept_bytes))
        + (_gb(row.peak_bytes), "yes" if row.same else "NO")
        for row in loadings
    )
    head = ("reader", "seconds", "times ours", "kept, GB", "peak, GB", "same arrays")
    return f"{first.rows} Gaussians, {first.file_bytes / 1e6:.0f} MB\n\n{markdown(head, lines)}"


@dataclass(frozen=True)
class MovingCost:
    """One kind of coarse image; medians over images, errors are means."""

    scale: float  # of the resolution
    merged: bool
    gaussians: int
    milliseconds: float
    processor: float  # milliseconds, all threads together
    psnr: float  # dB, to the full image; 100 for itself
    error: float  # mean absolute difference, values in [0, 1]


def measure_moving(command: Scale, progress: Progress = silent) -> list[MovingCost]:
    """Time of coarse images, each of another camera, and their distance from the full ones. A coarse image is
    enlarged as a screen does."""
    scene = open_scene(command.scene)
    if command.moving:
        scene = repeated(scene, command.moving)
    chosen = np.linspace(0, len(scene.cameras) - 1, command.views).astype(int)
    cameras = [scene.cameras[index].resized(*command.moving_size) for index in chosen]
    fewer = merged(scene.gaussians).gaussians
    rasterizer, settings = CpuRasterizer(), scene.raster_settings()

    def channels(gaussians: Gaussians, camera: Camera) -> Channels:
        drawn = splat_colours(rasterizer.view(gaussians, camera, settings), gaussians)
        return Channels(drawn.colours, drawn.alpha)

    full = [channels(scene.gaussians, camera).rgb.clip(0, 1) for camera in cameras]
    costs = []
    for done, (scale, is_merged) in enumerate(COARSE):
        progress("drawing", done / len(COARSE))
        gaussians = fewer if is_merged else scene.gaussians
        seconds, processor, decibels, errors = [], [], [], []
        for camera, wanted in zip(cameras, full, strict=True):
            small = camera.resized(max(round(camera.width * scale), 1), max(round(camera.height * scale), 1))
            wall, cpu = time.perf_counter(), time.process_time()
            drawn = channels(gaussians, small)
            compose_upwards(drawn, PictureConfig())
            seconds.append(time.perf_counter() - wall)
            processor.append(time.process_time() - cpu)
            shown = _enlarged(drawn.rgb.clip(0, 1), wanted.shape[1::-1])
            decibels.append(psnr(shown, wanted))
            errors.append(float(np.abs(shown - wanted).mean()))
        times = 1e3 * median(seconds), 1e3 * median(processor)
        costs.append(MovingCost(scale, is_merged, len(gaussians), *times, mean(decibels), mean(errors)))
    return costs


def _enlarged(image: Array, size: tuple[int, ...]) -> Array:
    """To (width, height), between pixels as a texture is."""
    width, height = size
    channels = (Image.fromarray(np.ascontiguousarray(channel)) for channel in np.moveaxis(image, -1, 0))
    enlarged = (channel.resize((width, height), Image.Resampling.BILINEAR) for channel in channels)
    return np.stack([np.asarray(channel) for channel in enlarged], -1)


def moving_table(costs: Sequence[MovingCost]) -> str:
    lines = (
        (f"{cost.scale:g}", f"{cost.gaussians}{' (merged)' if cost.merged else ''}")
        + (f"{cost.milliseconds:.0f}", f"{1e3 / cost.milliseconds:.1f}", f"{cost.processor:.0f}")
        + (f"{cost.psnr:.1f}", f"{cost.error:.1e}")
        for cost in costs
    )
    head = ("resolution", "Gaussians", "image, ms", "a second", "processor, ms", "PSNR, dB", "mean error")
    return markdown(head, lines)


@dataclass(frozen=True)
class Stretch:
    """Something done one or several times in one process."""

    what: str
    times: int
    seconds: float  # all of them, on the clock of the wall
    processor_seconds: float  # of all threads together: what other programs do changes them little
    peak_bytes: int | None  # of the process meanwhile; None where the system does not tell
    left_bytes: int | None  # of the process afterwards


def measure_endurance(command: Scale, progress: Progress = silent) -> list[Stretch]:
    """The scene repeated until it is large enough, its images, then its phrases."""
    scene = open_scene(command.scene)
    assert scene.language is not None
    encoder = load_text_encoder(scene.language.encoder_id)
    stretches: list[Stretch] = []

    def measure(what: str, doings: Sequence[Callable[[], object]]) -> None:
        restart_peak()
        start, busy = time.perf_counter(), time.process_time()
        for number, do in enumerate(doings):
            progress(what, number / len(doings))
            do()
        seconds, busy = time.perf_counter() - start, time.process_time() - busy
        peak = peak_memory()
        restart_peak()  # which gives free pages back
        stretches.append(Stretch(what, len(doings), seconds, busy, peak, resident_memory()))

    made: list[Scene] = []
    measure("the scene alone", [lambda: made.append(repeated(scene, command.count))])
    large = made.pop()
    camera = scene.cameras[0].resized(*command.size)
    draw = partial(render, large, camera)
    measure("the first image", [draw])
    for part in parts([draw] * command.images):
        measure("further images", part)
    engine = QueryEngine(large, lambda _: encoder)
    measure("regions, once", [lambda: engine.regions])
    asked = [partial(engine.run, text) for text in _two_words(encoder, command.phrases)]
    measure("the first phrase", asked[:1])
    for part in parts(asked[1:]):
        measure("further phrases", part)
    measure("the surface, once, for instances", [lambda: engine.surface])
    return stretches


def _two_words(encoder: TextEncoder, count: int) -> list[str]:
    """Different phrases of an adjective and a noun that the encoder was taught, at most `count`."""
    adjectives, nouns = (
        [word for word in bundled_vocabulary(name) if not encoder.unknown_words(word)]
        for name in ("adjectives", "nouns")
    )
    return [f"{adjective} {noun}" for noun in nouns for adjective in adjectives][:count]


def parts(doings: Sequence[Callable[[], object]]) -> list[Sequence[Callable[[], object]]]:
    """`PARTS` stretches of about the same number, none of them empty."""
    edges = [len(doings) * part // PARTS for part in range(PARTS + 1)]
    return [doings[a:b] for a, b in itertools.pairwise(edges) if b > a]


def endurance_table(stretches: Sequence[Stretch]) -> str:
    lines = (
        (row.what, row.times, f"{row.seconds / row.times:.3g}", f"{row.processor_seconds / row.times:.3g}")
        + (_gb(row.peak_bytes), _gb(row.left_bytes))
        for row in stretches
    )
    return markdown(("what", "times", "seconds each", "of the processor", "peak, GB", "left, GB"), lines)


def _gb(size: int | None) -> str:
    return "?" if size is None else f"{size / 1e9:.2f}"


REPORTS: Mapping[Part, tuple[Callable[[Scale, Progress], list[Any]], Callable[[Any], str]]] = {
    "load": (measure_loading, load_table),
    "moving": (measure_moving, moving_table),
    "endurance": (measure_endurance, endurance_table),
}


DEMO = Path(__file__).parents[2] / "assets" / "demo" / "scene.ply"
VIEWS = 4  # that images are compared in
HEAD = ("format", "MB", "position", "scale, %", "rotation, °", "opacity", "colour", "SH", "PSNR, dB")


@dataclass(frozen=True)
class Formats:
    """The largest errors of a scene written in each format and read back, and the lowest PSNR of images."""

    scenes: tyro.conf.Positional[tuple[Path, ...]] = (DEMO,)
    """Scenes to write."""

    def run(self) -> None:
        for path in self.scenes:
            scene = replace(load_scene(path), language=None, unread=())
            print(f"{path.name}: {len(scene.gaussians)} Gaussians of degree {scene.gaussians.sh_degree}\n")
            print(markdown(HEAD, rows(scene)))


def rows(scene: Scene) -> list[list[str]]:
    """The table's rows: format, megabytes, errors, lowest PSNR."""
    table = []
    with tempfile.TemporaryDirectory() as folder:
        for suffix in (row.suffix for row in formats() if row.write is not None):
            path = Path(folder) / f"scene{suffix}"
            save_scene(path, scene)
            got = load_scene(path).gaussians
            size, lowest = path.stat().st_size / 1e6, lowest_psnr(scene, got)
            told = [f"{error:.2g}" if error else "0" for error in errors(scene.gaussians, got)]
            table.append([suffix, f"{size:.2f}", *told, f"{lowest:.1f}"])
    return table


def errors(want: Gaussians, got: Gaussians) -> list[float]:
    """Largest error of rows that can be drawn: of positions (world units), scales (percent of the Gaussian's
    longest), rotations (degrees), opacities and base colours (of 1), and higher coefficients."""
    drawn = (rows.take(want.valid()) for rows in (want, got))
    a, b = ({name: array.astype(np.float64) for name, array in vars(rows).items()} for rows in drawn)
    kept = b["sh"][:, : a["sh"].shape[1]]
    colours = a["sh"].copy()  # what is lost is an error too
    colours[:, : kept.shape[1]] -= kept
    # Of two unit quaternions, by the sine of half the angle: a cosine knows no small angles.
    one, other = (unit(rows["quats_wxyz"], 1e-30) for rows in (a, b))
    halves = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1)) / 2
    axes, others = (np.exp(rows["log_scales"]) for rows in (a, b))
    differences = (
        b["means"] - a["means"],
        100 * (others - axes) / np.maximum(axes.max(axis=1, keepdims=True), 1e-300),
        np.degrees(4 * np.arcsin(halves.clip(0, 1))),
        sigmoid(b["opacity_logits"]) - sigmoid(a["opacity_logits"]),
        C0 * colours[:, 0],
        colours[:, 1:],
    )
    return [float(np.abs(difference).max(initial=0)) for difference in differences]


def lowest_psnr(scene: Scene, got: Gaussians) -> float:
    """Of images of `got` against those of the scene, dB; at most 100."""
    step = max(1, len(scene.cameras) // VIEWS)
    cameras = scene.cameras[::step][:VIEWS] or (scene.framing_camera((400, 320)),)
    scenes = (scene, replace(scene, gaussians=got))
    images = [[render(one, camera).colours.clip(0, 1) for one in scenes] for camera in cameras]
    return min(psnr(*pair) for pair in images)
