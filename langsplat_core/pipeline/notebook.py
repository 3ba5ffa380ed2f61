"""Scenes in a notebook: `show` puts the exported page into a frame of the cell, `draw` makes an image.

Nothing is served or fetched, and no widget is needed: the page is in the notebook's file, so that it stays
where the notebook is read without Python. A `Scene` or an answer at the end of a cell is shown by itself.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.composing import compose
from langsplat_core.display.displays import DISPLAYS, Channels, Subject, heats
from langsplat_core.errors import expect
from langsplat_core.pipeline.webpage import PageReport, make_page
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import ComposedResult, encoded_texts
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import parse
from langsplat_core.raster.render import render
from langsplat_core.scene import Camera, Scene
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class NotebookPage:
    """A page as the output of a cell."""

    text: str  # the HTML file
    report: PageReport
    height: int  # pixels; it is as wide as the cell

    def _repr_html_(self) -> str:
        """Return a frame that may run the page's own script and nothing else."""
        return (
            f'<iframe srcdoc="{html.escape(self.text)}" sandbox="allow-scripts allow-forms allow-downloads" '
            f'allow="fullscreen" style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )

    def __repr__(self) -> str:
        return f"a page of {self.report.gaussians:,} Gaussians, {self.report.bytes / 1e6:.1f} MB"


def show(
    source: Scene | QueryEngine,
    phrase: str = "",
    height: int = 540,
    at_most: int = 100_000,
    phrases: Sequence[str] = (),
) -> NotebookPage:
    """Return the page of a scene, or of the scene of an engine, in which `phrase` is asked.

    at_most: Gaussians that are drawn, those that cover most, so that a notebook stays small (the bundled
    scene's 81 288 are 6.5 MB); answers are those of the whole scene. phrases: with some the page has no
    encoder (2 MB of the bundled scene's), and knows these, in combinations too, and what was taught.
    """
    engine = source if isinstance(source, QueryEngine) else QueryEngine(source, load_text_encoder)
    scene = engine.scene
    if phrases:
        trees = [parse(name, engine.taught) for name in (phrase, *phrases) if name]
        known = [text for tree in trees for text in encoded_texts(engine, tree)]
        book = dict(zip(known, engine.texts.of(known), strict=True))
        own = replace(engine.field, phrasebook=book, taught=tuple(engine.taught.values()))
        scene = replace(scene, language=own)
        engine = QueryEngine(scene)
    title, asked = scene.path.stem if scene.path else "scene", None if scene.language is None else engine
    return NotebookPage(*make_page(scene, asked, title, phrase=phrase, at_most=at_most), height)


def draw(
    scene: Scene, size: tuple[int, int] = (960, 540), answer: QueryResult | ComposedResult | None = None
) -> Image.Image:
    """Return an image of a scene; an `answer` as heat, from the nearest camera that has it in its image."""
    expect(scene, Scene, "load_scene(path) returns one")
    expect(size, tuple | list, "say draw(scene, (width, height))")
    fitted = [camera.fitted(*size) for camera in scene.cameras]
    camera = fitted[0] if fitted else scene.framing_camera(size)
    answer = answer.answer if isinstance(answer, ComposedResult) else answer
    if answer is None:
        drawn = render(scene, camera)
        return Image.fromarray(compose(Channels(drawn.colours, drawn.alpha), PictureConfig()))
    expect(answer, QueryResult, 'run_phrase(engine, "cup") returns one')
    if answer.place is not None:
        camera = min(fitted, key=partial(view_distance, place=answer.place), default=camera)
    drawn = render(scene, camera, heats(Subject(len(scene.gaussians), answers=[answer])))
    heat = Channels(drawn.colours, drawn.alpha, drawn.values)
    ranges = DISPLAYS["relevancy"].ranges([answer])
    return Image.fromarray(compose(heat, PictureConfig(display="relevancy"), ranges))


def view_distance(camera: Camera, place: Array) -> float:
    """Return the distance of a place (3,) from a camera; far more where it is not well within its image."""
    pixels, depth = camera.project(place[None])
    inside = (np.abs(pixels[0] / (camera.width, camera.height) - 0.5) < 0.4).all() and depth[0] > 0
    return float(np.linalg.norm(camera.position - place)) + (0 if inside else 1e9)
