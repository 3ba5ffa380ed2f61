"""`langsplat query`: where in a scene a phrase is true."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from langsplat_core.cli.instances import instance_json, table, unit_of
from langsplat_core.config import CountOrZero, LevelChoice, PictureConfig, Positive
from langsplat_core.errors import EncoderError, InputError, LangSplatError
from langsplat_core.formats import load_scene
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import LoadEncoder, QueryEngine, TextEncoder, no_field
from langsplat_core.query.phrase_tree import Atom
from langsplat_core.query.pixels import decoded_relevancy, splatted_relevancy
from langsplat_core.query.places import peak_pixel
from langsplat_core.raster import load_rasterizer
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.phrases import split_phrases
from langsplat_core.semantics.encoders import load_text_encoder

PAPER_FILTER = 20  # px, mean filter before the peak is taken (paper, implementation details)


@dataclass(frozen=True)
class QueryScene:
    """Ask a scene for phrases: score, level, pixel, place in world units, box."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it."""
    texts: tyro.conf.Positional[tuple[str, ...]]
    """Phrases, each in quotes if it has several words; "," and ";" separate them too. What cannot be asked
    is named on stderr, and the rest is answered; with nothing left the exit code is 2."""
    level: LevelChoice = "auto"
    """Semantic level; auto takes the one that answers best, for a thing rather the whole."""
    whole: bool = False
    """Ask every phrase whole, without looking for structure such as "handle of the red mug"."""
    mode: Literal["splat", "paper"] = "splat"
    """splat: relevancy per Gaussian, then blended. paper: latents blended, every pixel decoded."""
    camera: Annotated[CountOrZero, tyro.conf.arg(metavar="INDEX")] = 0
    """Training view in which the pixel is reported."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""
    instances: CountOrZero = 5
    """How many of a phrase's things are listed, the best first."""
    scale: Positive | None = None
    """Metres per world unit, in place of what the scene says."""
    json: bool = False
    """Print JSON, lengths in world units."""

    def run(self) -> None:
        scene = load_scene(self.scene)
        if scene.language is None:
            raise InputError(f"{self.scene}: {no_field(scene)}")
        if not self.texts:
            raise InputError("no phrase given; for example: langsplat query scene.ply 'red cup'")
        camera = _camera(scene, self.camera)
        engine = QueryEngine(scene, _once(load_text_encoder), encoder_id=self.encoder)
        unit = unit_of(scene, self.scale)
        answers, tables = [], []
        for text in self._askable(engine, camera):
            result, understood = self._ask(engine, text, camera)
            answer = _answer(result, scene, engine, camera, self.mode) | {"reading": understood}
            answer |= {"encoder": engine.basis.encoder, "calibration": engine.basis.calibration}
            things = engine.instances(result, self.instances) if result.found else ()
            answer["metres_per_unit"] = unit.length if unit.name == "m" else None
            answer["instances"] = [instance_json(thing, number) for number, thing in enumerate(things, 1)]
            answers.append(answer)
            tables.append(table(things, unit))
        if self.json:
            json.dump(answers, sys.stdout, indent=1)
            print()
            return
        for answer, lines in zip(answers, tables, strict=True):
            verdict, reading = answer["verdict"], answer["reading"]
            if answer["probability"] is not None:
                verdict += f" ({100 * answer['probability']:.0f} %)"
            place = "-" if answer["place"] is None else f"{unit.format(answer['place'])} {unit.name}"
            print(
                f"{answer['phrase']}: {verdict}, score {answer['score']:.3f} at level {answer['level']}, "
                f"place {place}, pixel {answer['pixel']}",
                *([] if reading is None else [f"  read as: {reading}"]),
                *lines,
                sep="\n",
            )
        print(f"answers: {engine.basis.long}")

    def _askable(self, engine: QueryEngine, camera: Camera | None) -> list[str]:
        """The phrases that can be asked; of the others it is said why on stderr, before anything is searched.
        Raises that reason where none is left."""
        phrases = [phrase for text in self.texts for phrase in split_phrases(text) or [text]]
        problems: dict[str, LangSplatError] = {}
        for phrase in phrases:
            try:
                if self._plainly:
                    engine.text_vector(phrase)
                else:
                    check_phrase(engine, phrase, camera)
            except LangSplatError as error:
                problems[phrase] = error
        reasons = {
            str(error): [p for p, e in problems.items() if str(e) == str(error)]
            for error in problems.values()
        }
        if len(problems) == len(dict.fromkeys(phrases)):
            raise InputError("; ".join(reasons))
        for reason, unasked in reasons.items():
            print(f"langsplat: not asked: {', '.join(map(repr, unasked))}: {reason}", file=sys.stderr)
        return [phrase for phrase in phrases if phrase not in problems]

    @property
    def _plainly(self) -> bool:
        return self.whole or self.mode == "paper"

    def _ask(self, engine: QueryEngine, text: str, camera: Camera | None) -> tuple[QueryResult, str | None]:
        """The answer, and how the phrase was read where it has structure."""
        if self._plainly:
            return engine.run(text, self.level), None
        composed = run_phrase(engine, text, self.level, camera)
        return composed.answer, None if isinstance(composed.tree, Atom) else composed.reading


def _once(load: LoadEncoder) -> LoadEncoder:
    """Fails as it first did: a hub out of reach is not asked again by every phrase."""
    failed: list[EncoderError] = []

    def load_once(model: str) -> TextEncoder:
        if failed:
            raise failed[0]
        try:
            return load(model)
        except EncoderError as error:
            failed.append(error)
            raise

    return load_once


def _camera(scene: Scene, index: int) -> Camera | None:
    if not scene.cameras:
        return None
    if not 0 <= index < len(scene.cameras):
        raise InputError(f"--camera {index}: the scene has cameras 0 to {len(scene.cameras) - 1}")
    return scene.cameras[index]


def _answer(
    result: QueryResult, scene: Scene, engine: QueryEngine, camera: Camera | None, mode: str
) -> dict[str, Any]:
    """One phrase's answer, ready for JSON. Pixel fields are None without cameras."""
    answer: dict[str, Any] = {
        "phrase": result.phrase,
        "found": result.found,
        "verdict": result.verdict,
        "probability": result.probability,
        "score": result.peak,
        "level": LEVELS[result.level],
        "scores": dict(zip(LEVELS, result.scores, strict=True)),
        "place": None if result.place is None else result.place.tolist(),
        "box": None if result.box is None else result.box.tolist(),
        "pixel": None,
        "pixel_score": None,
        "view": None if camera is None else camera.name,
    }
    if camera is not None:
        view = load_rasterizer("cpu").view(scene.gaussians, camera, scene.raster_settings())
        gate = PictureConfig().alpha_gate
        if mode == "paper":
            phrase = engine.text_vector(result.phrase)[None]
            relevancy = decoded_relevancy(view, engine.field, result.level, phrase, gate)
        else:
            relevancy = splatted_relevancy(view, result.even[:, None], gate)
        column, row, score = peak_pixel(np.asarray(relevancy[..., 0]), PAPER_FILTER)
        answer |= {"pixel": [column, row], "pixel_score": score}
    return answer
