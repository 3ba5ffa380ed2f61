"""`langsplat query` and `select`: where in a scene a phrase is true, and that alone as a scene of its own."""

import logging
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from PIL import Image

from langsplat_core.arrays import Array, length_text
from langsplat_core.cli import arguments
from langsplat_core.cli.run import aligned, print_json
from langsplat_core.config import Count, CountOrZero, LevelChoice, PictureConfig
from langsplat_core.errors import EncoderError, InputError, LangSplatError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.scenes import check_writable, save_scene
from langsplat_core.io.sidecar import read_words
from langsplat_core.pipeline.evidence import draw_evidence, find_evidence, kept_features, kept_photographs
from langsplat_core.progress import TerminalProgress
from langsplat_core.query import compose
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import LoadEncoder, QueryEngine, TextEncoder, searchable
from langsplat_core.query.grammar import Atom, Counted, Phrase, heads, unparse
from langsplat_core.query.instances import Instance
from langsplat_core.query.lookup import decoded_relevancy, peak_pixel, splatted_relevancy
from langsplat_core.query.selection import of_rows, shares_in_masks
from langsplat_core.raster.protocol import CHANNELS_AT_ONCE, View
from langsplat_core.raster.render import view_of
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.language import split_phrases
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.sam import load_text_segmenter

log = logging.getLogger("langsplat")

# Answers in lines and as JSON, and places in images as users give them; other commands print so too.


@dataclass(frozen=True, eq=False)
class Unit:
    """The unit that lengths are printed and given in, and what places are relative to."""

    metres: float | None  # per world unit; None: unknown, and the unit is the world's
    origin: Array  # (3,) world units, of the scene

    @property
    def name(self) -> str:
        return "units" if self.metres is None else "m"

    @property
    def length(self) -> float:
        """Length of a world unit in this one."""
        return self.metres or 1.0

    def format(self, values: Array, between: str = " ") -> str:
        """Return lengths in world units as numbers of this unit, joined by `between`."""
        return length_text(self.length * np.asarray(values), between)

    def place(self, place: Array) -> str:
        """Return a place in the scene as numbers of this unit, in the world."""
        return length_text(self.length * place, origin=self.length * self.origin)


PLACES = ("place", "centre", "box")  # keys of positions


def in_world(content: Any, origin: Array) -> Any:
    """Return JSON `content` with its places, relative to `origin` (3,), moved into the world."""
    if isinstance(content, list | tuple):
        return [in_world(item, origin) for item in content]
    if not isinstance(content, dict) or not origin.any():
        return content
    return {
        key: origin + value if key in PLACES and value is not None else in_world(value, origin)
        for key, value in content.items()
    }


def instance_lines(instances: Sequence[Mapping[str, Any]], unit: Unit) -> list[str]:
    """Return aligned lines under a heading, one for each entry of `listed`; none without instances."""
    if not instances:
        return []
    rows = [("", "score", "share", "Gaussians", f"centre, {unit.name}", f"size, {unit.name}")]
    rows += [
        (
            str(one["number"]),
            f"{one['score']:.3f}",
            f"{100 * one['share']:.0f} %",
            f"{one['gaussians']}",
            unit.place(one["centre"]),
            unit.format(one["size"], " x "),
        )
        for one in instances
    ]
    return aligned(rows)


def listed(instances: Sequence[Instance]) -> dict[str, Any]:
    """Return instances, numbered from 1, ready for JSON, lengths in world units."""
    fields = []
    for number, one in enumerate(instances, 1):
        box = one.oriented
        shape = {"centre": box.centre, "rotation": box.axes, "half_extents": box.half_extents}
        scores = {"number": number, "score": one.score, "mean": one.mean, "share": one.share}
        place = {"centre": one.centre, "size": one.size, "box": one.box, "oriented_box": shape}
        fields.append(scores | {"gaussians": one.count} | place)
    return {"instances": fields}


def found_answer(engine: QueryEngine, text: str, level: LevelChoice) -> QueryResult:
    """Return the answer to a phrase; InputError where it was not found."""
    answer = compose.run_phrase(engine, text, level).answer
    if not answer.found or not answer.members.any():
        raise InputError(
            f"'{answer.phrase}' was not found (score {answer.peak:.3f}): nothing to select; ask in other "
            "words, or at another --level"
        )
    return answer


def chosen_instances(found: Sequence[Instance], numbers: Sequence[int]) -> Sequence[Instance]:
    """Return the instances of these numbers, the best is 1; all without numbers. InputError for others."""
    if not found:
        raise InputError("what was found lies nowhere on a surface: nothing to select")
    for number in numbers:
        if not 1 <= number <= len(found):
            raise InputError(f"--instance {number}: there are {len(found)}, numbered from 1")
    return [found[number - 1] for number in numbers] or found


def basis_fields(engine: QueryEngine) -> dict[str, Any]:
    """Return the basis of the answers, ready for JSON."""
    return {"encoder": engine.basis.encoder, "calibration": engine.basis.calibration}


def camera_of(scene: Scene, index: int) -> Camera:
    """Return the camera of a number; InputError where there is none."""
    if not 0 <= index < len(scene.cameras):
        known = f"cameras 0 to {len(scene.cameras) - 1}" if scene.cameras else "no cameras; leave it out"
        raise InputError(f"--camera {index}: the scene has {known}")
    return scene.cameras[index]


# The commands.

PAPER_FILTER = 20  # px, mean filter before the peak is taken (paper, implementation details)
NOT_DECODED = "--mode paper decodes pixels, and what was shown is compared with regions; leave it out"
_PHOTOGRAPHS = arguments.Needs("_sees", "--why or --segmenter")


@dataclass(frozen=True)
class QueryScene:
    """Ask a scene for phrases: score, level, pixel, place in world units, box."""

    scene: arguments.TrainedScene
    texts: arguments.Texts = ()
    """Phrases, each in quotes if it has several words; "," and ";" separate them too. What cannot be asked
    is named on stderr, and the rest is answered; with nothing left the exit code is 2."""
    taught: arguments.WordsOption = None
    level: LevelChoice = "auto"
    """Semantic level; auto takes the one that answers best, for a thing rather the whole."""
    mode: Literal["splat", "paper"] = "splat"
    """splat: relevancy per Gaussian, blended; paper: latents blended, pixels decoded, phrases asked whole."""
    camera: Annotated[CountOrZero | None, tyro.conf.arg(metavar="INDEX")] = None
    """Training view in which the pixel is reported: by default the first, and of up to 32 phrases."""
    encoder: arguments.EncoderOption = ""
    instances: CountOrZero = 5
    """How many of a phrase's things are listed, the best first."""
    scale: arguments.ScaleOption = None
    why: arguments.OutFile | None = None
    """Draw here, *.png, the best and worst photograph and mask behind each answer; --json has them, too."""
    segmenter: arguments.EncoderName = ""
    """Ask the photographs too, by a model such as facebook/sam3; answers say which of both found them."""
    work: Annotated[Path | None, tyro.conf.arg(metavar="FOLDER"), _PHOTOGRAPHS] = None
    """Folder of the training, with its masks (default: <scene>.work)."""
    photographs: Annotated[arguments.Photographs | None, _PHOTOGRAPHS] = None
    """The dataset of the training, if it is elsewhere now."""
    json: arguments.JsonOption = False

    def run(self) -> None:
        scene = searchable(self.scene)
        if not self.texts:
            raise InputError("no phrase given; for example: langsplat query scene.ply 'blue gift'")
        explain = _Explainer(self, scene) if self.why is not None else None
        camera = camera_of(scene, self.camera or 0) if scene.cameras or self.camera else None
        words = None if self.taught is None else read_words(self.taught)
        engine = QueryEngine(scene, once(load_text_encoder), encoder_id=self.encoder, words=words)
        texts = self._askable(engine, camera)
        outlined = self._outlined(scene, texts) if self.segmenter else {}
        view = self._view(scene, camera, len(texts))
        # One after the other: an answer has a number for every Gaussian and level.
        asked = {
            text: self._answered(engine, text, camera, view, outlined.get(text), explain)
            for text in dict.fromkeys(texts)
        }
        if explain is not None:
            explain.write()
        if self.json:
            print_json(in_world([asked[text] for text in texts], scene.origin))
            return
        unit = Unit(self.scale or scene.metres_per_unit, scene.origin)
        for text in texts:
            print(*_lines(asked[text], unit, len(scene.cameras)), sep="\n")
        print(f"answers: {engine.basis.long}")

    @property
    def _sees(self) -> bool:
        return bool(self.why or self.segmenter)

    def _outlined(self, scene: Scene, texts: Sequence[str]) -> dict[str, tuple[Array, int]]:
        """Return each phrase's masks for `compose.with_masks`, and the number of photographs with masks."""
        phrases = list(dict.fromkeys(texts))
        with TerminalProgress() as progress:
            photographs = kept_photographs(self.scene, scene, self.work, self.photographs, progress)
            progress("loading the segmenter", 0.0)
            segment = load_text_segmenter(self.segmenter).segment
            shares, counts = shares_in_masks(
                scene, lambda camera: segment(photographs[camera.name], phrases), progress
            )
        return dict(zip(phrases, zip(shares.T, counts.tolist(), strict=True), strict=True))

    def _view(self, scene: Scene, camera: Camera | None, count: int) -> View | None:
        if camera is not None and (self.camera is not None or count <= CHANNELS_AT_ONCE):
            return view_of(scene, camera)
        if camera is not None:
            log.info("pixels of more than %d phrases are found with --camera INDEX", CHANNELS_AT_ONCE)
        return None

    def _askable(self, engine: QueryEngine, camera: Camera | None) -> list[str]:
        """Return the phrases that can be asked; report others on stderr, raise if none is left."""
        phrases = [phrase for text in self.texts for phrase in split_phrases(text) or [text]]
        reasons: dict[str, list[str]] = {}  # why not -> these phrases
        if len(phrases) > 1:
            compose.encode_phrases(engine, phrases)
        for phrase in dict.fromkeys(phrases):
            try:
                if self.mode == "paper":
                    if engine.is_taught(phrase):
                        raise InputError(NOT_DECODED)
                    engine.texts.of([phrase])
                else:
                    compose.check_phrase(engine, phrase, camera)
            except LangSplatError as error:
                reasons.setdefault(str(error), []).append(phrase)
        unasked = {phrase for same in reasons.values() for phrase in same}
        if phrases and unasked.issuperset(phrases):
            raise InputError("; ".join(reasons))
        for reason, same in reasons.items():
            print(f"langsplat: not asked: {', '.join(map(repr, same))}: {reason}", file=sys.stderr)
        return [phrase for phrase in phrases if phrase not in unasked]

    def _answered(
        self,
        engine: QueryEngine,
        text: str,
        camera: Camera | None,
        view: View | None,
        outlined: tuple[Array, int] | None,
        explain: "_Explainer | None",
    ) -> dict[str, Any]:
        """Return the answer to a phrase with its instances, ready for JSON; what is printed is made of it."""
        result, tree, of = self._ask(engine, text, camera)
        masked = None if outlined is None else compose.with_masks(engine, result, outlined[0])
        result = result if masked is None else masked.answer
        answer = _answer(result, camera) | {"reading": None if tree is None else unparse(tree)}
        answer |= {} if view is None else _pixel(view, engine, result, self.mode)
        things = engine.instances(result, self.instances) if result.found else ()
        counts = result.found or (isinstance(tree, Counted) and result.verdict == "weak match")
        number = compose.count_instances(engine, result) if counts else compose.InstanceCount(0, 0, 0)
        metres = self.scale or engine.scene.metres_per_unit
        answer |= {"count": asdict(number)} | basis_fields(engine) | {"metres_per_unit": metres}
        answer |= listed(things)
        if explain is not None:
            answer["evidence"] = explain(engine, result, of)
        if masked is not None and outlined is not None:
            answer |= {"photographs_with_masks": outlined[1], "found_by": masked.found_by()}
            for entry, thing in zip(answer["instances"], things, strict=True):
                entry["found_by"] = masked.found_by(thing.members)
        return answer

    def _ask(
        self, engine: QueryEngine, text: str, camera: Camera | None
    ) -> tuple[QueryResult, Phrase | None, tuple[str, ...]]:
        """Return the answer, the phrase's tree where it has structure, and the words of what is asked for."""
        if self.mode == "paper":
            return engine.run(text, self.level), None, (text,)
        composed = compose.run_phrase(engine, text, self.level, camera)
        simple = isinstance(composed.tree, Atom)
        return composed.answer, None if simple else composed.tree, heads(composed.tree)


class _Explainer:
    """Evidence of answers, and the contact sheets of all of them in one image."""

    def __init__(self, asked: QueryScene, scene: Scene) -> None:
        """Find the masks and photographs; InputError where they are missing, before anything is asked."""
        assert asked.why is not None
        if asked.why.suffix.lower() != ".png":
            raise InputError(f"--why {asked.why}: evidence is drawn as an image; name a .png file")
        self._out, self._features = asked.why, kept_features(asked.scene, scene, asked.work)
        with TerminalProgress() as progress:
            place = asked.scene, scene, asked.work, asked.photographs
            self._photographs = kept_photographs(*place, progress)
        self._sheets = list[Array]()

    def __call__(
        self, engine: QueryEngine, answer: QueryResult, phrases: tuple[str, ...]
    ) -> dict[str, Any] | None:
        """Return the evidence of an answer, ready for JSON; it is drawn too."""
        with TerminalProgress() as progress:
            found = find_evidence(engine, answer, phrases, self._features, progress)
        if found is None:
            return None
        self._sheets.append(draw_evidence(found, answer, engine.scene, self._features, self._photographs))
        kept = {name: getattr(found, name) for name in ("phrase", "node", "fitting", "share", "interval")}
        rows = [asdict(vote) | {"agrees": vote.agrees} for vote in (*found.votes, *found.others)]
        counts = {"for": len(found.votes), "against": len(found.others)}
        return {"summary": str(found), **kept, **counts, "rows": rows}

    def write(self) -> None:
        """Write the sheets one below the other."""
        if not self._sheets:
            raise InputError(f"{self._out}: not written, because nothing in the scene answers")
        with atomic_path(self._out) as temporary:
            Image.fromarray(np.concatenate(self._sheets)).save(temporary, "PNG")


def once(load: LoadEncoder, instead: str = "") -> LoadEncoder:
    """Return `load`, or that of `instead`, called once for each encoder, also where a hub is out of reach."""

    @cache
    def tried(model: str) -> TextEncoder | EncoderError:
        try:
            return load(model)
        except EncoderError as error:
            return error

    def load_once(model: str) -> TextEncoder:
        if isinstance(found := tried(instead or model), EncoderError):
            raise found
        return found

    return load_once


def _answer(result: QueryResult, camera: Camera | None) -> dict[str, Any]:
    """Return a phrase's answer, ready for JSON, with the pixel as where no camera sees it."""
    return {
        "phrase": result.phrase,
        "found": result.found,
        "verdict": result.verdict,
        "said": result.said,
        "probability": result.probability,
        "by_chance": result.judgement.by_chance,
        "score": result.peak,
        "level": LEVELS[result.level],
        "scores": dict(zip(LEVELS, result.scores, strict=True)),
        "place": result.place,
        "box": result.box,
        "pixel": None,
        "pixel_score": None,
        "view": None if camera is None else camera.name,
    }


def _pixel(view: View, engine: QueryEngine, result: QueryResult, mode: str) -> dict[str, Any]:
    """Return the pixel of an answer in a view, and its score there, ready for JSON."""
    gate = PictureConfig().alpha_gate
    if mode == "paper":
        phrase = engine.texts.of([result.phrase])
        image = decoded_relevancy(view, engine.field, result.level, phrase, gate)
    else:
        image = splatted_relevancy(view, result.even[:, None], gate)
    column, row, score = peak_pixel(image[..., 0], PAPER_FILTER)
    return {"pixel": [column, row], "pixel_score": score}


def _lines(answer: dict[str, Any], unit: Unit, photographs: int) -> list[str]:
    """Return an answer as text: its verdict and place, how it was read and found, its instances, and why."""
    verdict, count = answer["said"], answer["count"]
    best, least, most = count["best"], count["least"], count["most"]
    if most > 1 or (most and not answer["found"]):
        verdict += f", {best} of them" + ("" if least == most else f" ({least} to {most})")
    shown = None if answer["verdict"] == "not here" else answer["place"]
    place = "none" if shown is None else f"{unit.place(shown)} {unit.name}"
    pixel = "" if shown is None or answer["pixel"] is None else f", pixel {answer['pixel']}"
    scored = f"score {answer['score']:.3f} at level {answer['level']}"
    lines = [f"{answer['phrase']}: {verdict}, {scored}, place {place}{pixel}"]
    if answer["reading"] is not None:
        lines.append(f"  read as: {answer['reading']}")
    if "found_by" in answer:
        by = [entry["found_by"] for entry in answer["instances"]]
        outlined = f"outlined in {answer['photographs_with_masks']} of {photographs} photographs"
        each = (f", {by.count(one)} listed by {one}" for one in dict.fromkeys(by))
        lines.append(f"  found by {answer['found_by']}: {outlined}{''.join(each)}")
    lines += instance_lines(answer["instances"], unit)
    if (evidence := answer.get("evidence")) is not None:
        votes = [row for row in evidence["rows"] if row["agrees"]]
        ends = {"best": votes[0], "worst": votes[-1]} if votes else {}
        fits = [f"{name} {vote['photograph']}, fit {vote['fit']:+.2f}" for name, vote in ends.items()]
        lines.append(f"  why: {'; '.join([evidence['summary'], *fits])}")
    return lines


@dataclass(frozen=True)
class Select:
    """Write what a phrase names as a scene of its own; with --remove, all the rest.

    Prints the things that were found, best first.
    """

    scene: arguments.TrainedScene
    texts: arguments.Texts
    """Phrases, each in quotes if it has several words; what any of them names is taken."""
    out: arguments.OutFile
    """Scene to write: .ply, .spz, .sog, .glb, .gltf, .usdc, .usda or .splat."""
    remove: bool = False
    """Write everything else instead."""
    level: LevelChoice = "auto"
    """Semantic level; auto takes for each phrase the one with the highest score."""
    instance: tuple[Count, ...] = ()
    """Numbers of the things to take, as printed, the best is 1; all if none is given."""
    scale: arguments.ScaleOption = None
    encoder: arguments.EncoderOption = ""
    taught: arguments.WordsOption = None
    json: arguments.JsonOption = False

    def run(self) -> None:
        if not self.texts:
            raise InputError("no phrase given; say: langsplat select scene.ply 'blue gift' --out gift.ply")
        check_writable(self.out, self.scene)
        if not self.out.parent.is_dir():
            raise InputError(f"{self.out.parent}: no such folder for {self.out.name}; make it first")
        scene = searchable(self.scene)
        unit = Unit(self.scale or scene.metres_per_unit, scene.origin)
        words = None if self.taught is None else read_words(self.taught)
        engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder, words=words)
        answers = [found_answer(engine, text, self.level) for text in self.texts]
        answer = answers[0] if len(answers) == 1 else compose.joined(answers, all_needed=True)
        found = engine.instances(answer)
        rows = np.concatenate([instance.members for instance in chosen_instances(found, self.instance)])
        selected = of_rows(rows, len(answer.members))
        if self.remove and selected.all():
            raise InputError("the selection is the whole scene: nothing would be left after --remove")
        rows = np.flatnonzero(~selected if self.remove else selected)
        save_scene(self.out, replace(scene.take(rows), path=self.out))
        self._print(found, unit, int(selected.sum()), len(rows))

    def _print(self, found: Sequence[Instance], unit: Unit, selected: int, written: int) -> None:
        if self.json:
            content = {
                "phrases": list(self.texts),
                "metres_per_unit": unit.metres,
                **listed(found),
                "taken": list(self.instance) or list(range(1, len(found) + 1)),
                "selected": selected,
                "removed": self.remove,
                "written": written,
                "out": str(self.out),
            }
            print_json(in_world(content, unit.origin))
            return
        print("\n".join(instance_lines(listed(found)["instances"], unit)))
        of = f"all but the {selected} selected" if self.remove else f"of {selected} selected"
        print(f"{self.out}: {written} Gaussians, {of}")
