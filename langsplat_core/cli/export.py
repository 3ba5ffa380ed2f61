"""Commands that make another file of a scene: `export`, `convert`, `transform`, `crop` and `scale`."""

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from langsplat_core import registry
from langsplat_core.cli.arguments import AnyScene, EncoderName, EncoderOption, WrittenScene
from langsplat_core.config import CodecConfig, Coordinate, Degrees, Level, Positive
from langsplat_core.errors import InputError
from langsplat_core.io import scenes
from langsplat_core.io.files import check_output_file, check_output_folder, write_whole
from langsplat_core.io.ply import write_metres
from langsplat_core.io.sidecar import rematch_language
from langsplat_core.io.spz import read_spz_scene, write_spz
from langsplat_core.pipeline.webpage import make_page
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.selection import in_box
from langsplat_core.scene import Scene, transform
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class Export:
    """Write a scene as one HTML file that any browser shows and searches, without a network or a server."""

    scene: AnyScene
    out: tyro.conf.Positional[Path]
    """Page to write, *.html; or --out OUT, -o OUT."""
    title: str = ""
    """Heading of the page, by default the scene's name."""
    view: str = ""
    """Name of the camera that the page opens with, by default the first."""
    encoder: EncoderOption = ""

    def run(self) -> None:
        if self.out.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"{self.out}: pages are written as .html; choose such a name")
        check_output_file(self.out)
        with TerminalProgress() as progress:
            progress("reading the scene", 0.0)
            scene = scenes.load_scene(self.scene)
            engine = None
            if scene.language is not None:
                engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
                if self.encoder:  # without it, a page is made that knows the phrasebook alone
                    engine.texts.encoder()
            first = [camera for camera in scene.cameras if self.view and camera.name == self.view][:1]
            if self.view and not first:
                raise InputError(f"--view {self.view}: {self.scene} has no camera of this name")
            text, report = make_page(scene, engine, self.title or self.out.stem, progress, first)
            write_whole(self.out, text)
        what = "any words of the scene's encoder" if report.free_text else f"{report.phrases:,} phrases"
        asked = f"nothing can be searched: {report.why_not}" if report.why_not else f"{what} can be searched"
        if scene.language is not None and not (report.why_not or report.free_text or report.phrases):
            asked += f": its encoder {scene.language.encoder_id} is not here; name it with --encoder"
        print(f"{self.out}: {report.gaussians:,} Gaussians, {report.bytes / 1e6:.2f} MB; {asked}")


@dataclass(frozen=True)
class Convert:
    """Write any readable scene in another format, with its language field and cameras beside it.

    A .ply keeps everything; what another format rounds or has no room for is printed. Checkpoints of other
    methods become a scene, and a scene becomes checkpoints: docs/files.md has what to give.
    """

    source: tyro.conf.Positional[Path]
    """Scene to read, of any format; or the first of the files that another method has of one scene."""
    rest: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[MORE...] OUT")]]
    """More of its files; last (or --out, -o) a folder, or .ply .spz .sog .glb .gltf .usdc .usda .splat."""
    rematch: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A language sidecar of before the Gaussians were edited, carried over to those of SOURCE by position."""
    to: Annotated[str, tyro.conf.arg(metavar="scene|langsplat")] = "scene"
    """langsplat: a folder with LangSplat's three checkpoints and its autoencoder."""
    encoder: EncoderName | None = None
    """Text encoder of the checkpoints' vectors: hub id, folder or "demo" (default: LangSplat's OpenCLIP,
    laion/CLIP-ViT-B-16-laion2B-s34B-b88K). With a single .ply: its semantic_* are read."""
    levels: tuple[Level, ...] = ()
    """Levels of the checkpoints with features, in their order, where files and folders do not tell."""
    phrases: tuple[str, ...] = ()
    """Stored encoded in a scene made of checkpoints: they can be asked without any encoder."""
    spz_version: Literal[3, 4] = 3
    """Of a written .spz. Spark reads up to 3, PlayCanvas's engine 4 alone, most programs both."""
    axes: Annotated[tuple[Literal["rub", "rdf"], ...], tyro.conf.arg(metavar="RUB|RDF ...")] = ()
    """Of an .spz: rub, y up as its README says, or rdf, y down as splat-transform and gsply read and write;
    of one that is read and does not say, and of one that is written, the last word."""
    codec: CodecConfig = CodecConfig()  # noqa: RUF009  (frozen)
    """How the Gaussians of checkpoints with whole vectors keep them."""

    @property
    def sources(self) -> tuple[Path, ...]:
        return (self.source, *self.rest[:-1])

    @property
    def out(self) -> Path:
        return self.rest[-1]

    def run(self) -> None:
        if not self.rest:
            raise InputError(f"{self.source}: name what to read, and then what to write")
        if self.to != "scene":
            self._export()
            return
        rematched = () if self.rematch is None else (self.rematch,)
        # Before minutes are spent on reading.
        row = scenes.check_writable(self.out, *self.sources, *rematched)
        of_spz = (self.source.suffix.lower(), row.suffix).count(".spz")
        if len(self.axes) > of_spz or (self.spz_version != 3 and row.suffix != ".spz"):
            raise InputError("--axes, a word for each, and --spz-version are of an .spz; leave them out")
        scene = self._read()
        write, axes = None, (self.axes or ("rub",))[-1]
        described = "with a language field" if scene.language else "without a language field"
        if row.suffix == ".spz":
            write = partial(write_spz, version=self.spz_version, axes=axes)
            described += f"; version {self.spz_version}, axes {axes.upper()}, recorded"
        scenes.save_scene(self.out, replace(scene, path=self.out), write=write)
        if row.rounds:
            print(f"{self.out}: rounds {row.rounds}")
        if self.out.name.lower().endswith(".compressed.ply"):
            print(f"{self.out}: written as a plain PLY; SuperSplat's compressed ones are only read")
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {described}")

    def _read(self) -> Scene:
        if (importer := self._importer()) is not None and self.rematch is not None:
            raise InputError("--rematch is for one scene; import the checkpoints, then rematch those")
        if importer is not None:
            name, reader = importer
            request = scenes.ImportRequest(self.sources, self.encoder, self.levels, self.phrases, self.codec)
            with TerminalProgress() as progress, scenes.failures("importers", name):
                scene, lines = reader.read(request, progress)
                if not isinstance(scene, Scene):
                    raise TypeError(f"it returns a {type(scene).__name__}, no Scene")
            print(*lines, sep="\n")
            return scene
        if self.levels or self.phrases or self.codec != CodecConfig():
            raise InputError("--levels, --phrases, --codec are for checkpoints; leave them out for a scene")
        spz = partial(read_spz_scene, axes=(self.axes or ("",))[0], note=print)
        read = spz if self.source.suffix.lower() == ".spz" else None
        if self.rematch is None:
            return scenes.load_scene(self.source, read)
        scene = scenes.load_without_language(self.source, read)
        return replace(scene, language=rematch_language(self.rematch, scene.in_world(scene.gaussians.means)))

    def _importer(self) -> tuple[str, scenes.Importer] | None:
        """Return what reads the sources where they are no scene of a known format, with its name."""
        importers: list[tuple[str, scenes.Importer]] = list(registry.parts("importers").items())
        suffix = self.source.suffix.lower()
        named = [(name, one) for name, one in importers if suffix in one.suffixes]
        if named or not (len(self.sources) > 1 or self.encoder is not None):
            return named[0] if named else None
        if not importers:
            raise InputError("several files, or --encoder, are for checkpoints, and no extension reads any")
        return importers[0]

    def _export(self) -> None:
        exporters = registry.references("exporters")
        if self.to not in exporters:
            raise InputError(f"--to {self.to}: choose one of {', '.join(('scene', *exporters))}")
        exporter: scenes.Exporter = registry.part("exporters", self.to)
        check_output_folder(self.out)
        scene = replace(self._read(), path=self.source)
        kind, keeper = f"files of --to {self.to}", f"*{scenes.ORIGIN_SUFFIX}"
        scenes.report_left_out(self.out, scene, kind, exporter.loses, keeper)
        with TerminalProgress() as progress, scenes.failures("exporters", self.to):
            lines = "\n".join(exporter.write(scene, self.out, progress))
        print(lines)


# Scenes edited by numbers; what belongs to them goes along.

Point = tuple[Coordinate, Coordinate, Coordinate]
Four = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Box = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Turn = tuple[Literal["x", "y", "z"], Degrees]


@dataclass(frozen=True)
class Transform:
    """Move, rotate and scale a whole scene, colours seen from the side, cameras and metres per unit included.

    Steps are taken in this order: --matrix, --up, --rotate, --scale, --move.
    """

    scene: AnyScene
    out: WrittenScene
    matrix: Annotated[tuple[Four, Four, Four, Four] | None, tyro.conf.arg(metavar="16 NUMBERS")] = None
    """A 4x4 matrix, row by row, as registration gives one: a rotation times a scale, and a move."""
    up: Axis | None = None
    """Turn the scene upright: what is up in it, by its cameras, becomes this axis."""
    rotate: Annotated[tyro.conf.UseAppendAction[tuple[Turn, ...]], tyro.conf.arg(metavar="AXIS DEGREES")] = ()
    """About the x, y or z axis through the origin, right-handed; may be given several times."""
    scale: Positive = 1.0
    """Factor about the origin. With the metres per unit that `langsplat inspect` prints, a unit becomes a
    metre; `langsplat scale` says how long a unit is and moves nothing."""
    move: Annotated[Point, tyro.conf.arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """World units."""

    def run(self) -> None:
        scenes.check_writable(self.out, self.scene)
        if self == Transform(self.scene, self.out):
            raise InputError("no step given; say one, such as --up z (`langsplat convert` makes a copy)")
        scene = scenes.load_scene(self.scene)
        to = self._similarity(scene)
        scenes.save_scene(self.out, replace(transform.place_scene(scene, to), path=self.out))
        rows = "  ".join(" ".join(f"{number:.15g}" for number in row) for row in to.matrix)
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {len(scene.cameras)} cameras; --matrix {rows}")

    def _similarity(self, scene: Scene) -> transform.Similarity:
        to = transform.IDENTITY if self.matrix is None else transform.similarity(np.array(self.matrix))
        if self.up is not None:
            to = to.then(transform.turning(to.rotation @ scene.up(), transform.AXES[self.up]))
        for axis, degrees in self.rotate:
            to = to.then(transform.rotating(transform.AXES[axis], degrees))
        return to.then(transform.scaling(self.scale)).then(transform.moving(np.array(self.move)))


@dataclass(frozen=True)
class Crop:
    """Keep the Gaussians whose centres lie in a box; what belongs to them goes along."""

    scene: AnyScene
    out: WrittenScene
    box: Annotated[Box, tyro.conf.arg(metavar="X Y Z X Y Z")]
    """Two opposite corners, world units."""

    def run(self) -> None:
        scenes.check_writable(self.out, self.scene)
        scene, corners = scenes.load_scene(self.scene), np.array(self.box).reshape(2, 3)
        keep = in_box(scene.gaussians.means, corners.min(0) - scene.origin, corners.max(0) - scene.origin)
        if not keep.any():
            where = f"`langsplat inspect {self.scene}` says where they lie"
            raise InputError(f"the crop holds none of the {len(keep)} Gaussians; {where}")
        scenes.save_scene(self.out, replace(scene.take(keep), path=self.out))
        print(f"{self.out}: {keep.sum()} of {len(keep)} Gaussians")


@dataclass(frozen=True)
class SetScale:
    """Say how long a scene's unit is, so that answers are in metres: by a known length in it, or by a factor.

    Without either, print what the scene says. Only the header of the .ply is changed.
    """

    scene: tyro.conf.Positional[Path]
    """The scene, *.ply."""
    metres: Positive | None = None
    """A known length, between the two points of --between."""
    between: Box | None = None
    """Two points that are --metres apart, x y z x y z in world units."""
    metres_per_unit: Positive | None = None
    """How long a unit is."""

    def run(self) -> None:
        if (self.metres is None) != (self.between is None):
            raise InputError("--metres and --between belong together: a length, and the points at its ends")
        if self.metres is not None and self.metres_per_unit is not None:
            raise InputError("give either --metres with --between, or --metres-per-unit")
        factor = self.metres_per_unit
        if self.metres is not None and self.between is not None:
            units = math.dist(self.between[:3], self.between[3:])
            if not 0 < units < math.inf:
                raise InputError(f"--between: points {units:g} units apart; must be above 0 and finite")
            factor = self.metres / units
        if factor is not None:
            write_metres(self.scene, factor)
        stored = scenes.load_without_language(self.scene).metres_per_unit
        print(f"{self.scene}: {'no scale' if stored is None else f'{stored:.6g} m per unit'}")
