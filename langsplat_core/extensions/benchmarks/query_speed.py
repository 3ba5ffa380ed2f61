"""The query benchmark (`langsplat bench query`): time and error of a phrase in every order of work.

All methods answer for the same vectors, the scene's codewords: the autoencoder of d = 3 is fitted to them
here. The paper's order blends latents, decodes every pixel of a view at three levels and compares (LangSplat,
section 3.4); it knows nothing but that view. The other two, cells of the sphere and a codebook, find the
relevancy of every Gaussian and answer with level, regions, verdict and place, which hold for all views; an
image then blends one number per Gaussian.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import tyro

from langsplat_core.arrays import Array
from langsplat_core.cli.arguments import OutFolder
from langsplat_core.config import AutoencoderConfig, Count, CountOrZero, PictureConfig
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.raster_speed import Size
from langsplat_core.extensions.benchmarks.report import markdown, write_report
from langsplat_core.progress import Progress, TerminalProgress, silent
from langsplat_core.query.engine import QueryEngine, TextEncoder, searchable
from langsplat_core.query.lookup import decoded_relevancy, splatted_relevancy
from langsplat_core.raster.protocol import View
from langsplat_core.raster.render import view_of
from langsplat_core.scene import LEVELS, Camera, Codec, LanguageField, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.relevancy import Scale, everyday_phrases, relevancy_of

GATE = PictureConfig().alpha_gate


@dataclass(frozen=True)
class BenchQuery:
    """Time phrases, cameras and frames on one scene in the paper's order and in ours, beside the error.

    The paper's order, a table and a codebook are compared by the error of relevancy. Some minutes, nearly all
    of them the paper's order.
    """

    scene: tyro.conf.Positional[Path]
    """A scene with a codebook, and its cameras beside it."""
    size: Size = (1440, 1080)
    """Width and height of the image, pixels; that of the paper's figures."""
    count: CountOrZero = 0
    """Gaussians; the scene's are repeated, each beside itself, until there are so many. 0: as they are."""
    phrases: Count = 8
    """Phrases that errors are averaged and times taken over; the paper's order is timed with one."""
    together: Count = 100
    """Phrases that are asked at once, and one by one."""
    repeats: Count = 5
    """Timings of a view and an image, of which the median is taken."""
    codec_steps: Count = 3_000
    """Training steps of the autoencoder that stands beside the codebook."""
    out: OutFolder = Path("bench_out")
    """Folder for query.md and query.json."""

    def run(self) -> None:
        scene = searchable(self.scene)
        assert scene.language is not None
        encoder = load_text_encoder(scene.language.encoder_id)
        with TerminalProgress() as progress:
            report = measure_queries(scene, encoder, self, progress)
        table = query_table(report)
        write_report(self.out, "query", table, {"config": asdict(self), "report": asdict(report)})
        print(table)


@dataclass(frozen=True)
class RelevancyError:
    """Absolute error of relevancy over all Gaussians with a meaning, levels and phrases."""

    mean: float
    p99: float


@dataclass(frozen=True)
class QueryCost:
    """Seconds and errors of one order of work."""

    way: str
    answer: float  # a new phrase: relevancy at three levels, and what else the way has to say
    shown: float  # a new phrase until its image is there, the camera standing still
    camera: float  # a new camera, before any phrase can be shown
    frame: float  # camera and image of a phrase already asked
    lookup: RelevancyError  # against exact dot products with what the latents decode to, in float64
    codec: RelevancyError  # against the codewords' 512 numbers, in float64


@dataclass(frozen=True)
class QueryReport:
    """Costs of all orders on one scene."""

    gaussians: int
    size: tuple[int, int]
    surface: float  # s, once for a scene: its surface
    regions: float  # s, likewise: the codebook's regions
    costs: tuple[QueryCost, ...]
    phrases: int
    alone: float  # s per phrase, codebook, asked and encoded one by one
    together: float  # s per phrase, all at once


@dataclass(frozen=True, eq=False)
class _Asked:
    """Phrases, and the codewords of the scene that they are compared with."""

    texts: Sequence[str]
    vectors: Array  # (Q, D)
    codes: Array  # (3, N) codeword of every Gaussian
    known: Array  # (3, N)
    codewords: Array  # (K, D)

    def exact(self, codewords: Array, scale: Scale) -> list[Array]:
        """Relevancies of each phrase at all Gaussians with a meaning, in float64."""
        doubles = codewords.astype(np.float64)
        zero, rate = scale.of(doubles @ scale.texts.T)
        rows = (relevancy_of(doubles @ vector, zero, rate) for vector in self.vectors.astype(np.float64))
        return [np.asarray(row[self.codes[self.known]]) for row in rows]


def measure_queries(
    scene: Scene, encoder: TextEncoder, config: BenchQuery, progress: Progress = silent
) -> QueryReport:
    """`scene` must have a codebook and a camera; InputError otherwise. The paper's order takes minutes."""
    from langsplat_core.training.language.codec_fit import train_autoencoder  # imports torch

    if scene.language is None or scene.language.codec.blends or not scene.cameras:
        raise InputError("bench query needs a scene with a codebook and training cameras")
    scene = repeated(scene, config.count) if config.count else scene
    field = scene.language
    assert field is not None
    words = everyday_phrases(encoder.unknown_words)
    engine = QueryEngine(scene, lambda _: encoder)
    progress("finding surface and regions", 0.0)
    surface, regions = _seconds(lambda: engine.surface), _seconds(lambda: engine.regions)
    progress("asking one by one and all at once", 0.1)
    texts = words[: config.together]
    engine.run_many(texts[:2])
    alone = _seconds(lambda: [engine.run(text) for text in texts]) / len(texts)
    together = _seconds(lambda: engine.run_many(texts)) / len(texts)
    texts = words[: config.phrases]
    codewords = field.codec.decode(np.arange(field.codec.size, dtype=np.uint16)[:, None])
    asked = _Asked(texts, engine.text_vectors(texts), field.latents[..., 0], field.known, codewords)
    fitted = train_autoencoder(codewords, AutoencoderConfig(steps=config.codec_steps), progress)
    encoded = with_codec(field, fitted)
    by_cells = QueryEngine(replace(scene, language=encoded), lambda _: encoder)
    camera = scene.cameras[0].resized(*config.size)
    progress("the paper's order", 0.3)
    costs = (
        _paper(scene, encoded, camera, asked),
        _ours("cells", by_cells, camera, asked, config.repeats),
        _ours("codebook", engine, camera, asked, config.repeats),
    )
    progress("asking", 1.0)
    count = min(len(words), config.together)
    return QueryReport(len(scene.gaussians), config.size, surface, regions, costs, count, alone, together)


def repeated(scene: Scene, count: int) -> Scene:
    """`count` Gaussians: the scene's over and over, each moved by a random step of its own size."""
    larger = scene.take(np.resize(np.arange(len(scene.gaussians)), count))
    gaussians = larger.gaussians
    steps = np.random.default_rng(0).normal(size=(count, 3)) * np.exp(gaussians.log_scales)
    return replace(larger, gaussians=replace(gaussians, means=gaussians.means + steps))


def with_codec(field: LanguageField, codec: Codec) -> LanguageField:
    """`field`, which has a codebook, with its codewords encoded by another codec."""
    codewords = field.codec.decode(np.arange(field.codec.size, dtype=np.uint16)[:, None])
    latents = codec.encode(codewords)[field.latents[..., 0]]
    return replace(field, latents=np.where(field.known[..., None], latents, 0), codec=codec)


def _paper(scene: Scene, field: LanguageField, camera: Camera, asked: _Asked) -> QueryCost:
    """Costs of the paper's order of work. Decoding is measured once: it takes a minute and more."""
    view_of(scene, camera).splat(field.latents[0])
    views: list[View] = []
    seen = _seconds(lambda: views.append(view_of(scene, camera)))
    blending = _seconds(lambda: [views[0].splat(latents) for latents in field.latents])
    vectors = asked.vectors[:1]
    both = _seconds(
        lambda: [decoded_relevancy(views[0], field, level, vectors, GATE) for level in range(len(LEVELS))]
    )
    decoding = max(both - blending, 0.0)
    published = Scale(field.canonical, None, field.temperature)
    decoded = field.codec.decode(field.codec.encode(asked.codewords))
    error = _error(asked.exact(decoded, published), asked.exact(asked.codewords, published))
    none = RelevancyError(0.0, 0.0)  # it decodes
    return QueryCost("paper's order", decoding, decoding, seen + blending, seen + both, none, error)


def _ours(way: str, engine: QueryEngine, camera: Camera, asked: _Asked, repeats: int) -> QueryCost:
    scene, codec = engine.scene, engine.field.codec
    engine.text_vectors(asked.texts)  # what is encoded and built once is encoded and built now
    result = engine.run(asked.texts[0])
    found = [engine.relevancy(vector)[asked.known] for vector in asked.vectors]
    answer = median(_seconds(partial(engine.run, text)) for text in list(asked.texts) * repeats)
    view = view_of(scene, camera)
    seen = median(_seconds(lambda: view_of(scene, camera)) for _ in range(repeats))
    splatted_relevancy(view, result.even[:, None], GATE)
    image = median(
        _seconds(lambda: splatted_relevancy(view, result.even[:, None], GATE)) for _ in range(repeats)
    )
    decoded = codec.decode(codec.encode(asked.codewords)) if codec.blends else asked.codewords
    errors = (_error(found, asked.exact(each, engine.scale)) for each in (decoded, asked.codewords))
    return QueryCost(way, answer, answer + image, seen, seen + image, *errors)


def _error(got: Sequence[Array], want: Sequence[Array]) -> RelevancyError:
    apart = np.abs(np.concatenate(got).astype(np.float64) - np.concatenate(want))
    return RelevancyError(*map(float, (apart.mean(), np.quantile(apart, 0.99)) if len(apart) else (0, 0)))


def _seconds(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def query_table(report: QueryReport) -> str:
    """Both tables as Markdown; ratios are to the paper's order."""
    paper, (width, height) = report.costs[0], report.size
    head = (
        *("order", "new phrase", "times faster", "shown", "new camera", "frame"),
        *("lookup error", "codec error"),
    )
    rows = (
        (cost.way, f"{1e3 * cost.answer:.1f}", f"{paper.answer / max(cost.answer, 1e-9):.0f}")
        + tuple(f"{1e3 * value:.1f}" for value in (cost.shown, cost.camera, cost.frame))
        + tuple(f"{error.mean:.1e} / {error.p99:.1e}" for error in (cost.lookup, cost.codec))
        for cost in report.costs
    )
    return (
        f"{report.gaussians} Gaussians, {width}x{height}; milliseconds; errors of relevancy, mean / 99 %\n\n"
        f"{markdown(head, rows)}\n"
        f"Once for the scene: surface {report.surface:.1f} s, regions {report.regions:.1f} s. "
        f"{report.phrases} phrases, encoded and answered: {1e3 * report.alone:.1f} ms each one by one, "
        f"{1e3 * report.together:.1f} ms at once.\n"
    )
