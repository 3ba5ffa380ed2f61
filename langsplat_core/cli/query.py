"""`langsplat query`, `select` and `describe`: where in a scene a phrase is true, that alone as a scene of its
own, and words for what is there."""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from PIL import Image
from rich.table import Table

from langsplat_core.arrays import Array
from langsplat_core.cli.run import OutFile, OutputConsole
from langsplat_core.cli.teach import Level, camera_of, pixel_in, pointed, searchable
from langsplat_core.config import Count, CountOrZero, LevelChoice, NotNegative, PictureConfig, Positive
from langsplat_core.errors import EncoderError, InputError, LangSplatError
from langsplat_core.io.files import atomic_path
from langsplat_core.io.language import read_words
from langsplat_core.io.scenes import check_writable, save_scene
from langsplat_core.io.shapes import (
    MESH_SUFFIXES,
    POINT_SUFFIXES,
    base_colours,
    check_suffix,
    write_meshes,
    write_points,
)
from langsplat_core.pipeline.evidence import (
    draw_evidence,
    find_evidence,
    kept_features,
    kept_photographs,
)
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.query.answers import QueryResult, peak_pixel
from langsplat_core.query.compose import Number, check_phrase, count_things, joined, run_phrase
from langsplat_core.query.describe import Describer, Entry, Words, look_at_pixel
from langsplat_core.query.engine import LoadEncoder, QueryEngine, TextEncoder
from langsplat_core.query.grammar import Atom, heads
from langsplat_core.query.instances import Instance, hull
from langsplat_core.query.lookup import decoded_relevancy, splatted_relevancy
from langsplat_core.query.selection import grow, of_rows, shrink
from langsplat_core.raster import load_lifting_rasterizer, load_rasterizer
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.language import split_phrases
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.vocabulary import read_vocabulary

PAPER_FILTER = 20  # px, mean filter before the peak is taken (paper, implementation details)
NOT_DECODED = "--mode paper decodes pixels, and what was shown is compared with regions; leave it out"
WIDTH = 118  # characters of a table that is not written to a terminal


@dataclass(frozen=True)
class QueryScene:
    """Ask a scene for phrases: score, level, pixel, place in world units, box."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it."""
    texts: tyro.conf.Positional[tuple[str, ...]] = ()
    """Phrases, each in quotes if it has several words; "," and ";" separate them too. What cannot be asked
    is named on stderr, and the rest is answered; with nothing left the exit code is 2."""
    like: Annotated[str, tyro.conf.arg(metavar="X,Y")] = ""
    """Find more like what is in this pixel of the --camera, at --level; auto: like the whole thing."""
    taught: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own words, as `langsplat teach --into FILE` writes them, beside those of the scene."""
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
    why: OutFile | None = None
    """Draw the evidence here, *.png: the photographs and masks that the best region of each answer stands on,
    best and worst. --json then has it, too."""
    work: Path | None = None
    """Folder of the training, with its masks, for --why (default: <scene>.work)."""
    photographs: Path | None = None
    """The dataset of the training, for --why, if it is elsewhere now."""
    json: bool = False
    """Print JSON, lengths in world units."""

    def run(self) -> None:
        scene = searchable(self.scene)
        self._check()
        explain = _Explainer(self, scene) if self.why is not None else None
        camera = camera_of(scene, self.camera) if scene.cameras else None
        engine = _engine(scene, _once(load_text_encoder), self.encoder, self.taught)
        unit = _unit(scene, self.scale)
        found = [self._ask(engine, text, camera) for text in self._askable(engine, camera)]
        if self.like:
            level = "whole" if self.level == "auto" else self.level
            alike = engine.like(pointed(engine, self.camera, self.like, "--like", level), level)
            found.append((replace(alike, phrase=f"like {self.like}"), None, ()))
        answers, tables = [], []
        for result, understood, of in found:
            answer = _answer(result, scene, engine, camera, self.mode) | {"reading": understood}
            things = engine.instances(result, self.instances) if result.found else ()
            number = count_things(engine, result) if result.found else Number(0, 0, 0)
            answer |= {"count": {"best": number.best, "least": number.least, "most": number.most}}
            because = {} if explain is None else {"evidence": explain(engine, result, of)}
            answer |= _basis(engine) | {"metres_per_unit": unit.metres, **_listed(things)}
            answers.append(answer | because)
            tables.append(_table(things, unit) + _reasons(**because))
        if explain is not None:
            explain.write()
        if self.json:
            _print_json(answers)
            return
        for answer, lines in zip(answers, tables, strict=True):
            verdict, reading = answer["verdict"], answer["reading"]
            if answer["probability"] is not None:
                verdict += f" ({100 * answer['probability']:.0f} %)"
            if answer["count"]["most"] > 1:
                verdict += f", {_counted(**answer['count'])}"
            place = "-" if answer["place"] is None else f"{unit.format(answer['place'])} {unit.name}"
            print(
                f"{answer['phrase']}: {verdict}, score {answer['score']:.3f} at level {answer['level']}, "
                f"place {place}, pixel {answer['pixel']}",
                *([] if reading is None else [f"  read as: {reading}"]),
                *lines,
                sep="\n",
            )
        print(f"answers: {engine.basis.long}")

    def _check(self) -> None:
        if not self.texts and not self.like:
            raise InputError("no phrase given; for example: langsplat query scene.ply 'red cup'")
        if self.like and self.mode == "paper":
            raise InputError(NOT_DECODED)
        if self.like and self.why is not None:
            raise InputError("--why is of phrases; give what --like finds a name with `langsplat teach`")

    def _askable(self, engine: QueryEngine, camera: Camera | None) -> list[str]:
        """The phrases that can be asked; the others are named on stderr with the reason, before anything is
        searched. Raises that reason where none is left."""
        phrases = [phrase for text in self.texts for phrase in split_phrases(text) or [text]]
        reasons: dict[str, list[str]] = {}  # why not -> these phrases
        for phrase in dict.fromkeys(phrases):
            try:
                if self.mode == "paper" and engine.is_taught(phrase):
                    raise InputError(NOT_DECODED)
                if self._plainly and not engine.is_taught(phrase):
                    engine.text_vector(phrase)
                else:
                    check_phrase(engine, phrase, camera)
            except LangSplatError as error:
                reasons.setdefault(str(error), []).append(phrase)
        unasked = {phrase for same in reasons.values() for phrase in same}
        if phrases and unasked.issuperset(phrases):
            raise InputError("; ".join(reasons))
        for reason, same in reasons.items():
            print(f"langsplat: not asked: {', '.join(map(repr, same))}: {reason}", file=sys.stderr)
        return [phrase for phrase in phrases if phrase not in unasked]

    @property
    def _plainly(self) -> bool:
        return self.whole or self.mode == "paper"

    def _ask(
        self, engine: QueryEngine, text: str, camera: Camera | None
    ) -> tuple[QueryResult, str | None, tuple[str, ...]]:
        """The answer, how the phrase was read where it has structure, and the words of what is asked for."""
        if self._plainly:
            return engine.run(text, self.level), None, (text,)
        composed = run_phrase(engine, text, self.level, camera)
        simple = isinstance(composed.tree, Atom)
        return composed.answer, None if simple else composed.reading, heads(composed.tree)


class _Explainer:
    """Evidence of answers, and the contact sheets of all of them in one image."""

    def __init__(self, asked: QueryScene, scene: Scene) -> None:
        """Raises InputError where masks or photographs are missing, before anything is asked."""
        assert asked.why is not None
        if asked.why.suffix.lower() != ".png":
            raise InputError(f"--why {asked.why}: evidence is drawn as an image; name a .png file")
        self._out, self._features = asked.why, kept_features(asked.scene, scene, asked.work)
        with TerminalProgress() as progress:
            place = asked.scene, scene, asked.work, asked.photographs
            self._photographs = kept_photographs(*place, progress)
        self._rasterizer, self._sheets = load_rasterizer("cpu"), list[Array]()

    def __call__(
        self, engine: QueryEngine, answer: QueryResult, phrases: tuple[str, ...]
    ) -> dict[str, Any] | None:
        """The evidence of an answer, ready for JSON; it is drawn too."""
        with TerminalProgress() as progress:
            found = find_evidence(engine, answer, phrases, self._features, self._rasterizer, progress)
        if found is None:
            return None
        source = engine.scene, self._features, self._photographs, self._rasterizer
        self._sheets.append(draw_evidence(found, answer, *source))
        return {
            "summary": str(found),
            "phrase": found.phrase,
            "node": found.node,
            "for": len(found.votes),
            "against": len(found.others),
            "fitting": found.fitting,
            "share": found.share,
            "interval": list(found.interval),
            "rows": [asdict(vote) | {"agrees": vote.agrees} for vote in (*found.votes, *found.others)],
        }

    def write(self) -> None:
        """Write the sheets one below the other."""
        if not self._sheets:
            raise InputError(f"{self._out}: not written, because nothing in the scene answers")
        with atomic_path(self._out) as temporary:
            Image.fromarray(np.concatenate(self._sheets)).save(temporary, "PNG")


def _reasons(evidence: dict[str, Any] | None = None) -> list[str]:
    if evidence is None:
        return []
    votes = [row for row in evidence["rows"] if row["agrees"]]
    ends = [] if not votes else [("best", votes[0]), ("worst", votes[-1])]
    said = [f"{name} {row['photograph']}, fit {row['fit']:+.2f}" for name, row in ends]
    return [f"  why: {'; '.join([evidence['summary'], *said])}"]


def _once(load: LoadEncoder) -> LoadEncoder:
    """`load`, but a hub out of reach is not asked again by every phrase: it fails as it first did."""
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


def _engine(scene: Scene, load: LoadEncoder, encoder: str, taught: Path | None) -> QueryEngine:
    words = None if taught is None else read_words(taught)
    try:
        return QueryEngine(scene, load, encoder_id=encoder, words=words)
    except EncoderError as error:
        raise EncoderError(f"{taught}: {error}") from None


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


def _counted(best: int, least: int, most: int) -> str:
    return f"{best} of them" if least == most else f"{best} of them ({least} to {most})"


# `langsplat select`.

Shape = Literal["scene", "points", "hull"]


@dataclass(frozen=True)
class Select:
    """Write what a phrase names as a scene of its own, with its language field and cameras, as points or as a
    mesh; or, with --remove, the scene without it. Prints the things that were found, best first."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it."""
    texts: tyro.conf.Positional[tuple[str, ...]]
    """Phrases, each in quotes if it has several words; what any of them names is taken."""
    out: OutFile
    """File to write: .ply, .spz or .splat for a scene, .ply for points, .ply or .obj for hulls."""
    remove: bool = False
    """Write everything else instead."""
    level: LevelChoice = "auto"
    """Semantic level; auto takes for each phrase the one with the highest score."""
    instance: tuple[Count, ...] = ()
    """Numbers of the things to take, as printed, the best is 1; all if none is given."""
    grow: NotNegative = 0.0
    """Take also what is so near along the surface: metres if the scene has a scale, else world units."""
    shrink: NotNegative = 0.0
    """Leave out what is so near to the rest along the surface, in the same unit; after growing."""
    shape: Annotated[Shape, tyro.conf.arg(name="as")] = "scene"
    """scene: Gaussians. points: their centres, with colour and relevancy. hull: a closed mesh around each."""
    scale: Positive | None = None
    """Metres per world unit, in place of what the scene says."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""
    taught: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own words, as `langsplat teach --into FILE` writes them, beside those of the scene."""
    json: bool = False
    """Print JSON, lengths in world units."""

    def run(self) -> None:
        self._check()
        scene = searchable(self.scene)
        unit = _unit(scene, self.scale)
        engine = _engine(scene, load_text_encoder, self.encoder, self.taught)
        answers = [_found(engine, text, self.level) for text in self.texts]
        answer = answers[0] if len(answers) == 1 else joined(answers, all_needed=True)
        found = engine.instances(answer)
        rows = np.concatenate([instance.members for instance in _chosen(found, self.instance)])
        selected = self._reshaped(engine, of_rows(rows, len(answer.members)), unit)
        written = self._write(engine, replace(answer, members=selected))
        self._print(found, unit, int(selected.sum()), written)

    def _check(self) -> None:
        """InputError for what needs no scene to be known: it should not cost the loading of one."""
        if not self.texts:
            raise InputError(
                "no phrase given; for example: langsplat select scene.ply 'red cup' --out cup.ply"
            )
        if self.shape == "scene":
            check_writable(self.out)
        else:
            check_suffix(self.out, POINT_SUFFIXES if self.shape == "points" else MESH_SUFFIXES)
        if self.shape == "hull" and self.remove:
            raise InputError(
                "--as hull is the shape of things; what is left after --remove is written as points"
            )
        if self.out.resolve() == self.scene.resolve():
            raise InputError(f"{self.out}: would replace the original scene; choose another --out")
        folder = self.out.parent
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder for {self.out.name}; make it first")

    def _reshaped(self, engine: QueryEngine, selected: Array, unit: "Unit") -> Array:
        if self.grow:
            selected = grow(engine.surface, selected, self.grow / unit.length)
        if self.shrink:
            selected = shrink(engine.surface, selected, self.shrink / unit.length)
        if not selected.any():
            raise InputError(f"--shrink {self.shrink:g}: nothing is left; shrink by less")
        if self.remove and selected.all():
            raise InputError("the selection is the whole scene: nothing would be left after --remove")
        return selected

    def _write(self, engine: QueryEngine, answer: QueryResult) -> int:
        """Number of Gaussians, points or meshes that were written."""
        scene, rows = engine.scene, np.flatnonzero(~answer.members if self.remove else answer.members)
        if self.shape == "points":
            relevancy = answer.relevancy[answer.level][rows]
            return write_points(self.out, scene.gaussians.take(rows), {"relevancy": relevancy})
        if self.shape == "hull":
            colours, name = base_colours(scene.gaussians), " ".join(self.texts)
            meshes = [
                hull(instance, scene.gaussians, colours, f"{name} {number}")
                for number, instance in enumerate(engine.instances(answer), 1)
            ]
            write_meshes(self.out, meshes)
            return len(meshes)
        save_scene(self.out, replace(scene.take(rows), path=self.out))
        return len(rows)

    def _print(self, found: Sequence[Instance], unit: "Unit", selected: int, written: int) -> None:
        if self.json:
            content = {
                "phrases": list(self.texts),
                "metres_per_unit": unit.metres,
                **_listed(found),
                "taken": list(self.instance) or list(range(1, len(found) + 1)),
                "selected": selected,
                "as": self.shape,
                "removed": self.remove,
                "written": written,
                "out": str(self.out),
            }
            _print_json(content)
            return
        print("\n".join(_table(found, unit)))
        what = {"scene": "Gaussians", "points": "points", "hull": "closed hulls"}[self.shape]
        of = f"all but the {selected} selected" if self.remove else f"of {selected} selected Gaussians"
        print(f"{self.out}: {written} {what}, {of}")


# `langsplat describe`.


@dataclass(frozen=True)
class Describe:
    """Name what is here: the best words of a vocabulary for a pixel, a Gaussian or an instance of a phrase,
    or the scene's inventory."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it."""
    camera: Annotated[CountOrZero, tyro.conf.arg(metavar="INDEX")] = 0
    """Training view in which --pixel is meant."""
    pixel: Annotated[tuple[CountOrZero, CountOrZero] | None, tyro.conf.arg(metavar="X Y")] = None
    """Column and row, counted from the top left pixel, 0 0."""
    gaussian: Annotated[CountOrZero | None, tyro.conf.arg(metavar="NUMBER")] = None
    """One Gaussian, by its row in the file, from 0."""
    phrase: Annotated[str | None, tyro.conf.arg(metavar="TEXT")] = None
    """A thing that this phrase finds."""
    instance: Annotated[Count, tyro.conf.arg(metavar="NUMBER")] = 1
    """Which of the things that --phrase finds, as `langsplat query` lists them; the best is 1."""
    level: Level | None = None
    """This semantic level alone."""
    outline: bool = False
    """The scene as a tree: wholes, with their parts under them."""
    top: Count = 5
    """Words per level."""
    vocabulary: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own list, one phrase per line, in place of the bundled everyday things and parts."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        phrases = None if self.vocabulary is None else read_vocabulary(self.vocabulary)
        scene = searchable(self.scene)
        self._check(scene)
        with TerminalProgress() as progress:
            engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
            describer = Describer(engine, phrases, progress)
            answer = self._described(describer, progress)
        if self.json:
            _print_json(answer | _basis(engine))
            return
        if self.outline:
            named = [one for one in answer["outline"] if one["word"] is not None or one["parts"]]
            _print_outline(named, _unit(scene, None))
            if len(named) < len(answer["outline"]):
                print(f"and {len(answer['outline']) - len(named)} without a name, which --json lists")
        elif self._everything:
            _print_inventory(answer["inventory"])
        else:
            _print_words(answer["levels"])
        print(f"answers: {engine.basis.long}")
        if describer.left_out:
            names = ", ".join(describer.left_out[:3]) + (" ..." if len(describer.left_out) > 3 else "")
            print(
                f"{answer['asked']} phrases were compared; {len(describer.left_out)} were left out, because "
                f"the encoder was never taught their words ({names})"
            )

    @property
    def _everything(self) -> bool:
        return self._asked_of == []

    @property
    def _asked_of(self) -> list[str]:
        """The options that name a place."""
        given = {"--pixel": self.pixel, "--gaussian": self.gaussian, "--phrase": self.phrase}
        return [option for option, value in given.items() if value is not None]

    def _check(self, scene: Scene) -> None:
        """InputError for arguments that do not go with the scene or each other, before anything is loaded."""
        if self.outline and (self._asked_of or self.level is not None):
            raise InputError(
                "--outline is of the whole scene, at all levels; leave out what else is asked for"
            )
        if len(self._asked_of) > 1:
            raise InputError(f"{' and '.join(self._asked_of)} are several questions; ask one of them")
        if self.phrase is None and self.instance != 1:
            raise InputError(f"--instance {self.instance} needs a --phrase that finds it")
        count = len(scene.gaussians)
        if self.gaussian is not None and not 0 <= self.gaussian < count:
            raise InputError(f"--gaussian {self.gaussian}: the scene has Gaussians 0 to {count - 1}")
        if self.pixel is None:
            if self.camera != 0:
                raise InputError(f"--camera {self.camera} needs a --pixel X Y in it")
            return
        if not scene.cameras:
            raise InputError(f"{self.scene}: has no cameras, so --pixel means nothing; ask by --gaussian")
        pixel_in(scene, self.camera, self.pixel, "--pixel {} {}".format(*self.pixel))

    def _described(self, describer: Describer, progress: Progress) -> dict[str, Any]:
        """The inventory, or the words of the place that is asked for, ready for JSON."""
        engine = describer.engine
        sure = engine.basis.calibration is not None
        asked = {"asked": len(describer.words[0].phrases), "left_out": len(describer.left_out)}
        if self.outline:
            return asked | {"outline": [_plain(one, sure) for one in describer.outline()]}
        found: Sequence[Words | Entry]
        place: dict[str, Any] = {}
        if self.pixel is not None:
            camera = engine.scene.cameras[self.camera]
            at = look_at_pixel(load_lifting_rasterizer("cpu"), describer, camera, self.pixel, top=self.top)
            found = describer.at_gaussians(np.zeros(0, np.int64)) if at is None else at.words
            place = {"camera": self.camera, "view": camera.name, "pixel": list(self.pixel)}
        elif self.phrase is not None:
            instances = engine.instances(_found(engine, self.phrase, "auto"))
            thing = _chosen(instances, [self.instance])[0]
            found = describer.at_gaussians(thing.members, top=self.top)
            place = {"phrase": self.phrase, "thing": _instance(thing, self.instance)}
        elif self.gaussian is not None:
            found = describer.at_gaussians(np.array([self.gaussian]), np.ones(1), self.top)
            place = {"gaussian": self.gaussian}
        else:
            found = describer.inventory(progress)
        wanted = [_plain(one, sure) for one in found if self.level in (None, LEVELS[one.level])]
        return place | asked | {"inventory" if self._everything else "levels": wanted}


def _plain(value: Any, sure: bool) -> Any:
    """Words, spots and entries, ready for JSON. A share of the softmax over a vocabulary is a probability too
    where that is `sure`."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, tuple):
        return [_plain(item, sure) for item in value]
    if not is_dataclass(value):
        return value
    made: dict[str, Any] = {}
    for name in (field.name for field in fields(value)):
        held = getattr(value, name)
        if name == "level":
            made[name] = LEVELS[held]
        elif name == "rows":
            made["gaussians"] = len(held)
        elif name == "probability":
            made |= {"softmax": held, "probability": held if sure else None}
        else:
            made[name] = _plain(held, sure)
    return made


def _looks(described: dict[str, Any]) -> str:
    return " ".join(described[key]["phrase"] for key in ("colour", "material") if described[key] is not None)


def _percent(described: dict[str, Any]) -> str:
    return "" if described["probability"] is None else f" {100 * described['probability']:.0f} %"


def _print_inventory(entries: list[dict[str, Any]]) -> None:
    table = Table("what", "also", "level", "p %", "surface %", "looks", "centre", box=None)
    for entry in entries:
        names = (
            entry["phrase"],
            ", ".join(entry["also"]),
            entry["level"],
            _percent(entry).strip(" %") or "-",
        )
        for number, spot in enumerate(entry["spots"]):
            centre = " ".join(f"{value:.2f}" for value in spot["centre"])
            start = names if number == 0 else ("", "", "", "")
            table.add_row(*start, f"{100 * spot['share']:.2f}", _looks(spot), centre)
    console = OutputConsole()
    OutputConsole(width=max(WIDTH, console.width)).print(table)
    if not entries:
        print("nothing of the vocabulary was found in the scene")


def _print_outline(nodes: list[dict[str, Any]], unit: "Unit", depth: int = 0) -> None:
    """Nodes with their parts indented under them; a line for those of one name that have none, too."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for node in nodes:
        name = None if node["word"] is None else node["word"]["phrase"]
        groups.setdefault(node["node"] if node["parts"] or name is None else name, []).append(node)
    for group in groups.values():
        node = group[0]
        word = "?" if node["word"] is None else f"{node['word']['phrase']}{_percent(node['word'])}"
        what = [
            node["level"],
            f"{unit.format(np.array(node['size']), ' x ')} {unit.name}",
            f"{node['count']} Gaussians",
        ]
        if any(node["votes"]):
            what.append(f"outlined in {node['votes'][0]} of {sum(node['votes'])} photographs")
        times = f"{len(group)} x " if len(group) > 1 else ""
        print(f"{'  ' * depth}{times}{word}: {'the largest ' if times else ''}{', '.join(what)}")
        _print_outline(node["parts"], unit, depth + 1)


def _print_words(levels: list[dict[str, Any]]) -> None:
    for level in reversed(levels):
        if not level["words"]:
            print(f"{level['level']:<8} nothing is known here")
            continue
        said = ", ".join(word["phrase"] + _percent(word) for word in level["words"])
        looks = _looks(level)
        print(f"{level['level']:<8} {said}" + (f"; looks {looks}" if looks else ""))


# Scenes, instances and JSON, as all three print them.


@dataclass(frozen=True)
class Unit:
    """The unit that lengths are printed and given in."""

    name: str  # "m" or "units"
    length: float  # world units -> this

    @property
    def metres(self) -> float | None:
        """Metres per world unit, where they are known."""
        return self.length if self.name == "m" else None

    def format(self, values: Array, between: str = " ") -> str:
        """World units as text, in this unit, without it."""
        return between.join(f"{self.length * value:.3f}" for value in values)


def _unit(scene: Scene, metres_per_unit: float | None = None) -> Unit:
    """Metres by `metres_per_unit`, else by the scene's own, else world units."""
    metres = metres_per_unit or scene.metres_per_unit
    return Unit("units", 1.0) if metres is None else Unit("m", metres)


def _table(instances: Sequence[Instance], unit: Unit) -> list[str]:
    """Aligned lines under a heading, one for each instance; none without instances."""
    if not instances:
        return []
    rows = [("", "score", "share", "Gaussians", f"centre, {unit.name}", f"size, {unit.name}")]
    rows += [
        (
            str(number),
            f"{instance.score:.3f}",
            f"{100 * instance.share:.0f} %",
            f"{instance.count}",
            unit.format(instance.centre),
            unit.format(instance.size, " x "),
        )
        for number, instance in enumerate(instances, 1)
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
    ]


def _listed(instances: Sequence[Instance]) -> dict[str, Any]:
    return {"instances": [_instance(instance, number) for number, instance in enumerate(instances, 1)]}


def _instance(instance: Instance, number: int) -> dict[str, Any]:
    """An instance, ready for JSON, lengths in world units."""
    box = instance.oriented
    return {
        "number": number,
        "score": instance.score,
        "mean": instance.mean,
        "share": instance.share,
        "gaussians": instance.count,
        "centre": instance.centre.tolist(),
        "size": instance.size.tolist(),
        "box": instance.box.tolist(),
        "oriented_box": {
            "centre": box.centre.tolist(),
            "rotation": box.axes.tolist(),
            "half_extents": box.half_extents.tolist(),
        },
    }


def _found(engine: QueryEngine, text: str, level: LevelChoice) -> QueryResult:
    """The answer to a phrase; InputError where it was not found."""
    answer = run_phrase(engine, text, level).answer
    if not answer.found or not answer.members.any():
        raise InputError(
            f"'{answer.phrase}' was not found (score {answer.peak:.3f}): nothing to select; ask in other "
            "words, or at another --level"
        )
    return answer


def _chosen(found: Sequence[Instance], numbers: Sequence[int]) -> Sequence[Instance]:
    """The instances of these numbers, the best is 1; all without numbers. Raises InputError for another."""
    if not found:
        raise InputError("what was found lies nowhere on a surface: nothing to select")
    for number in numbers:
        if not 1 <= number <= len(found):
            raise InputError(f"--instance {number}: there are {len(found)}, numbered from 1")
    return [found[number - 1] for number in numbers] or found


def _basis(engine: QueryEngine) -> dict[str, Any]:
    return {"encoder": engine.basis.encoder, "calibration": engine.basis.calibration}


def _print_json(content: Any) -> None:
    json.dump(content, sys.stdout, indent=1)
    print()
