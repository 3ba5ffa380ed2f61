"""One process, a large scene, large pictures and many phrases: time, memory, and whether it grows
(`langsplat bench endurance`)."""

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from langsplat_core.lab.config import EnduranceConfig
from langsplat_core.lab.speed.queries import repeated
from langsplat_core.lab.speed.resident import peak_memory, resident_memory, restart_peak
from langsplat_core.progress import Progress, silent
from langsplat_core.query.engine import QueryEngine, TextEncoder
from langsplat_core.raster.render import render
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.vocabulary import ADJECTIVES, NOUNS

PARTS = 4  # that phrases and pictures are measured in: what grows is seen from one to the next


@dataclass(frozen=True)
class Stretch:
    """Something done one or several times."""

    what: str
    times: int
    seconds: float  # all of them, on the clock of the wall
    processor_seconds: float  # of all threads together: what other programs do changes them little
    peak_bytes: int | None  # of the process meanwhile; None where the system does not tell
    left_bytes: int | None  # of the process afterwards


def measure_endurance(
    scene: Scene, encoder: TextEncoder, config: EnduranceConfig, progress: Progress = silent
) -> list[Stretch]:
    """`scene` must have a language field and a camera. It is repeated until it is large enough."""
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
    measure("the scene alone", [lambda: made.append(repeated(scene, config.count))])
    large = made.pop()
    camera = scene.cameras[0].resized(*config.size)
    measure("the first picture", [partial(draw, large, camera)])
    for part in parts([partial(draw, large, camera)] * config.pictures):
        measure("further pictures", part)
    engine = QueryEngine(large, lambda _: encoder)
    measure("surface and regions, once", [lambda: engine.regions])
    asked = [partial(engine.run, text) for text in two_words(encoder, config.phrases)]
    measure("the first phrase", asked[:1])
    for part in parts(asked[1:]):
        measure("further phrases", part)
    return stretches


def draw(scene: Scene, camera: Camera) -> None:
    """A picture that is not kept."""
    render(scene, camera)


def two_words(encoder: TextEncoder, count: int) -> list[str]:
    """Different phrases of an adjective and a noun that the encoder was taught, at most `count`."""
    adjectives, nouns = ([w for w in words if not encoder.unknown_words(w)] for words in (ADJECTIVES, NOUNS))
    return [f"{adjective} {noun}" for noun in nouns for adjective in adjectives][:count]


def parts(doings: Sequence[Callable[[], object]]) -> list[Sequence[Callable[[], object]]]:
    """`PARTS` stretches of about the same number, none of them empty."""
    edges = [len(doings) * part // PARTS for part in range(PARTS + 1)]
    return [doings[a:b] for a, b in itertools.pairwise(edges) if b > a]


def endurance_table(config: EnduranceConfig, stretches: Sequence[Stretch]) -> str:
    """Markdown."""
    lines = [
        f"{config.count} Gaussians, pictures of {config.size[0]}x{config.size[1]}",
        "",
        "| what | times | seconds each | of the processor | peak, GB | left, GB |",
        "|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row.what} | {row.times} | {row.seconds / row.times:.3g} "
        f"| {row.processor_seconds / row.times:.3g} | {_gb(row.peak_bytes)} | {_gb(row.left_bytes)} |"
        for row in stretches
    ]
    return "\n".join(lines) + "\n"


def _gb(size: int | None) -> str:
    return "?" if size is None else f"{size / 1e9:.2f}"
