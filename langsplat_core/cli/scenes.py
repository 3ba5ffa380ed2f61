"""`langsplat inspect`, `doctor`, `convert`, `compact` and `scale`: commands on scene files."""

import ctypes.util
import importlib.metadata
import json
import math
import os
import platform
from dataclasses import asdict, dataclass, field, replace
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.table import Table
from rich.text import Text

from langsplat_core import __version__
from langsplat_core.cli.run import OutFile, OutputConsole
from langsplat_core.cli.teach import Level
from langsplat_core.config import CodebookConfig, CodecConfig, CompactConfig, Positive, Range
from langsplat_core.errors import EXTRAS, BackendError, InputError, LangSplatError, remedy
from langsplat_core.io.files import check_output_folder
from langsplat_core.io.language import rematch_language
from langsplat_core.io.ply import write_metres
from langsplat_core.io.scenes import (
    check_keeps,
    check_writable,
    load_scene,
    load_without_language,
    save_scene,
)
from langsplat_core.io.summary import NEEDLE, OPACITY_EDGES, SceneSummary, disk_bytes, summarise
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoder import OPEN_MODEL
from langsplat_core.semantics.encoders import load_text_encoder

OPTIONAL = ("torch", "transformers", "pycolmap", "matplotlib", "gsplat")
LIBRARIES = {
    "EGL": "libegl1",
    "GL": "libgl1",
    "X11": "libx11-6",
    "usb-1.0": "libusb-1.0-0",
}  # Debian's packages


@dataclass(frozen=True)
class Inspect:
    """Print what a scene file holds, how healthy its rows are and where its bytes go."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        scene = load_scene(self.scene)
        summary = summarise(scene)
        size = disk_bytes(self.scene)
        if self.json:
            said = {"scene": str(self.scene), "disk_bytes": size, "unread": scene.unread, **asdict(summary)}
            print(json.dumps(said, indent=1))
            return
        table = Table.grid(padding=(0, 2))
        for name, value in [("on disk", f"{size / 1e6:.2f} MB, companions included"), *_lines(summary)]:
            table.add_row(name, Text(value))
        if scene.language is not None:
            table.add_row("answers", Text(QueryEngine(scene).basis.long))
        for reason in scene.unread:
            table.add_row("not read", Text(reason))
        OutputConsole().print(table)


def _lines(a: SceneSummary) -> list[tuple[str, str]]:
    """Rows of the report: a name, and a value for people."""
    reasons = "".join(f"; {count} {reason}" for reason, count in a.invalid.items())
    low, high = (" ".join(f"{value:.3g}" for value in corner) for corner in a.bounds)
    median, most, largest = ("infinite" if ratio is None else f"{ratio:.3g}" for ratio in a.anisotropy)
    hidden, *shares = accumulate(a.opacity_shares)  # of the Gaussians below each edge
    energy = " + ".join(f"{100 * share:.3g} %" for share in a.sh_energy)
    below = [f"{_percent(s)} < {edge:g}" for s, edge in zip(shares, OPACITY_EDGES[2:-1], strict=False)]
    lines = [
        ("in memory", f"{a.memory_bytes / 1e6:.2f} MB"),
        ("Gaussians", f"{a.gaussians:,}"),
        ("invalid rows", f"{a.invalid_rows}{reasons}"),
        ("duplicates", f"{a.duplicates}"),
        ("bounds (1-99 %)", f"{low}  to  {high}"),
        ("opacity", ", ".join([f"{_percent(hidden)} never drawn", *below])),
        ("anisotropy", f"median {median}, 99 % {most}, largest {largest}; {a.needles} > {NEEDLE:g}"),
        ("SH degree", f"{a.sh_degree}; energy by degree {energy}"),
        ("antialiased", "yes (Mip-Splatting)" if a.antialiased else "no"),
        ("scale", f"{a.metres_per_unit:g} m per unit" if a.metres_per_unit else "unknown: `langsplat scale`"),
        ("extra properties", ", ".join(a.extras) or "none"),
        ("cameras", f"{a.cameras}" if a.cameras else "none"),
    ]
    field = a.language
    if field is None:
        return [*lines, ("language field", "none")]
    observed = ", ".join(f"{name} {_percent(share)}" for name, share in field.observed.items())
    return [
        *lines,
        ("language field", f"codec {field.codec} of {field.size}; {field.bytes / 1e6:.2f} MB in memory"),
        ("text encoder", f"{field.encoder}, {field.vector_dim} numbers"),
        ("phrasebook", f"{field.phrases} phrases"),
        ("taught words", ", ".join(field.taught) or "none"),
        ("observed", observed),
        (
            "tree",
            "none" if field.nodes is None else f"{', '.join(map(str, field.nodes))} nodes at the levels",
        ),
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


@dataclass(frozen=True)
class Doctor:
    """Print what this machine has, for a report of trouble."""

    def run(self) -> None:
        print(f"langsplat        {__version__}")
        print(
            f"python           {platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"
        )
        for package in ("numpy", "numba", "moderngl", "imgui-bundle", *OPTIONAL):
            print(f"{package:<16} {_version(package)}")
        for library, package in LIBRARIES.items():
            found = ctypes.util.find_library(library)
            print(f"lib{library:<13} {found or f'missing: apt install {package}'}")
        print(f"DISPLAY          {os.environ.get('DISPLAY') or 'not set: use --headless'}")
        print(f"OpenGL           {_opengl()}")
        print(f"text encoder     {_encoder()}")


def _opengl() -> str:
    """Name of the OpenGL that draws without a window, or why there is none and what to do."""
    from langsplat_core.raster.opengl.scene_textures import create_egl_context

    try:
        context = create_egl_context()
    except BackendError as error:
        return str(error)
    try:
        about = context.info
        return f"{about['GL_VERSION']} on {about['GL_RENDERER']}"
    finally:
        context.release()


def _encoder() -> str:
    """State of the bundled encoder, and what real photographs want."""
    try:
        encoder = load_text_encoder("demo")
        encoder.encode_texts(["red mug"])
    except LangSplatError as error:
        return str(error)
    return f"demo: works; for real photographs `hf download {OPEN_MODEL}`, see docs/encoders.md"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return f"missing: {remedy(package)}" if package in EXTRAS else "missing"


CHECKPOINTS = (".pth", ".pt", ".ckpt", ".npz", ".npy", ".faiss")  # no scene has such a name
Target = Literal["scene", "langsplat", "occam", "features"]


@dataclass(frozen=True)
class Convert:
    """Write any readable scene as .ply, .spz or .splat, with language field and cameras beside it if it has
    them. A .ply (INRIA's) keeps everything, .spz is ten times smaller and rounded, .splat is without view
    dependence. Checkpoints of LangSplat, LangSplatV2, Occam's LGS, Dr. Splat, OpenGaussian, Feature-3DGS and
    3D Gaussian Splatting become such a scene (see docs/files.md for what to give), and a scene becomes
    checkpoints."""

    source: tyro.conf.Positional[Path]
    """Scene to read, of any format; or the first of the files that another method has of one scene."""
    rest: tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[MORE...] OUT")]]
    """The other method's further files, in any order, and last the scene to write: .ply, .spz or .splat; with
    --to the folder."""
    rematch: Path | None = None
    """A language sidecar (*.langsplat.safetensors) made before the Gaussians were edited: its field is
    carried over to the Gaussians of SOURCE by nearest position."""
    to: Target = "scene"
    """langsplat: a folder with LangSplat's three checkpoints and its autoencoder. occam: with Occam's LGS's
    three checkpoints of whole vectors. features: a folder of masks and vectors of photographs, `features` of
    a training's work folder as LangSplat's language_features, or the other way."""
    encoder: str | None = None
    """Text encoder of the checkpoints' vectors: hub id, folder or "demo" (default: LangSplat's OpenCLIP,
    laion/CLIP-ViT-B-16-laion2B-s34B-b88K). With a single .ply: its semantic_* are read."""
    levels: tuple[Level, ...] = ()
    """Levels of the checkpoints with features, in their order, where files and folders do not tell."""
    phrases: tuple[str, ...] = ()
    """Stored encoded in a scene made of checkpoints: they can be asked without any encoder."""
    codec: CodecConfig = CodebookConfig()  # noqa: RUF009  (frozen)
    """How the Gaussians of checkpoints with whole vectors keep them."""

    @property
    def sources(self) -> tuple[Path, ...]:
        """The files that are read."""
        return (self.source, *self.rest[:-1])

    @property
    def out(self) -> Path:
        """The file or folder that is written."""
        return self.rest[-1]

    def run(self) -> None:
        if not self.rest:
            raise InputError(f"{self.source}: name what to read, and then what to write")
        if self.to == "features":
            self._convert_features()
        elif self.to == "scene":
            self._write_scene()
        else:
            self._export()

    def _write_scene(self) -> None:
        check_writable(self.out)  # before minutes are spent on reading
        check_keeps(self.out, *self.sources, *([] if self.rematch is None else [self.rematch]))
        scene = self._read()
        save_scene(self.out, replace(scene, path=self.out))
        described = "with a language field" if scene.language else "without a language field"
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {described}")

    def _read(self) -> Scene:
        first = self.source
        foreign = len(self.sources) > 1 or first.suffix.lower() in CHECKPOINTS or self.encoder is not None
        if foreign and self.rematch is not None:
            raise InputError(
                "--rematch is for one scene; import the checkpoints first, then rematch the result"
            )
        if foreign:
            return self._import()
        if self.rematch is None:
            return load_scene(first)
        scene = load_without_language(first)
        return replace(scene, language=rematch_language(self.rematch, scene.gaussians.means))

    def _import(self) -> Scene:
        from langsplat_core.io.foreign import read_foreign
        from langsplat_core.pipeline.importing import import_scene  # imports torch: --help need not wait

        foreign = read_foreign(self.sources, self.levels)
        with TerminalProgress() as progress:
            scene, report = import_scene(foreign, self.encoder, self.phrases, self.codec, progress)
        print(f"{report.method}: {'; '.join(report.notes)}")
        if scene.language is not None:
            shares = ", ".join(f"{share:.0%}" for share in report.meaningful)
            print(
                f"with a meaning at subpart, part, whole: {shares} of the Gaussians; "
                f"codec {report.codec} of {report.codec_size}, encoder {scene.language.encoder_id}"
            )
        if report.loss is not None:
            print(
                f"relevancy error of the codec: mean {report.loss.error_mean:.4f}, "
                f"99 % below {report.loss.error_p99:.4f}; mean cosine {report.loss.cosine:.4f}"
            )
        return scene

    def _export(self) -> None:
        from langsplat_core.pipeline.exporting import export_langsplat, export_occam

        check_output_folder(self.out)
        scene = replace(self._read(), path=self.source)
        with TerminalProgress() as progress:
            if self.to == "langsplat":
                written = export_langsplat(scene, self.out, self.source.stem)
            else:
                written = export_occam(scene, self.out, progress)
        for path in written:
            print(path)

    def _convert_features(self) -> None:
        from langsplat_core.pipeline.exporting import (
            features_from_langsplat,
            features_to_langsplat,
            langsplat_stems,
        )
        from langsplat_core.semantics.store import FeatureStore

        folder = self.source
        if len(self.sources) > 1 or not folder.is_dir():
            raise InputError(f"{folder}: --to features reads one folder of masks and vectors of photographs")
        check_output_folder(self.out)
        with TerminalProgress() as progress:
            if langsplat_stems(folder):
                count = features_from_langsplat(folder, FeatureStore(self.out), progress)
            else:
                count = features_to_langsplat(FeatureStore(folder), self.out, progress)
        print(f"{self.out}: masks and vectors of {count} photographs")


if TYPE_CHECKING:
    from langsplat_core.compaction.compact import CompactReport


@dataclass(frozen=True)
class Compact:
    """Drop the Gaussians and colour harmonics that the views do not need, within an error budget. Nothing
    is retrained; the language field, the cameras and extra properties are taken along."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: OutFile | None = None
    """The scene to write (default: SCENE with .compact.ply for its ending)."""
    photos: Path | None = None
    """Dataset the scene was trained on: the loss is then measured against its photographs."""
    json: bool = False
    """Print JSON."""
    config: Annotated[CompactConfig, tyro.conf.arg(name="")] = field(default_factory=CompactConfig)

    def run(self) -> None:
        from langsplat_core.compaction.compact import compact_scene

        out = self.out or self.scene.with_name(self.scene.name.split(".")[0] + ".compact.ply")
        with TerminalProgress() as progress:
            report = compact_scene(self.scene, out, self.config, self.photos, progress)
        if self.json:
            print(json.dumps({"out": str(out), **asdict(report)}, indent=1))
            return
        console = OutputConsole()
        console.print(_table(report))
        for line in (*_notes(report), f"written: {out}"):
            console.print(line, soft_wrap=True, highlight=False, markup=False)


def _table(report: "CompactReport") -> Table:
    table = Table("", "before", "after", "after / before")
    for column in table.columns[1:]:
        column.justify = "right"
    before, after = report.before, report.after

    def row(name: str, old: float, new: float, form: str, factor: float = 1.0) -> None:
        share = f"{100 * new / old:.1f} %" if old else "-"
        table.add_row(name, format(old * factor, form), format(new * factor, form), share)

    row("Gaussians", before.gaussians, after.gaussians, ",d", 1)
    table.add_row("SH degree", str(before.sh_degree), str(after.sh_degree), "")
    row("on disk, MB", before.disk_bytes, after.disk_bytes, ".2f", 1e-6)
    row("in memory, MB", before.memory_bytes, after.memory_bytes, ".2f", 1e-6)
    if before.psnr is not None and after.psnr is not None:
        table.add_row("PSNR, dB", f"{before.psnr:.2f}", f"{after.psnr:.2f}", "")
    return table


def _notes(report: "CompactReport") -> list[str]:
    how = (
        "measured on photographs"
        if report.assumed_psnr is None
        else f"derived from the change, if the scene has {report.assumed_psnr:g} dB"
    )
    lines = [
        f"loss: {report.loss:.3f} dB of {report.budget:g} allowed, worst view "
        f"{report.worst_loss:.2f} dB ({how})",
        f"views: {report.ranking_views} ranked the Gaussians, {report.measuring_views} others measured; "
        f"{report.views_from}",
    ]
    for answer in report.answers:
        place = "no place" if answer.moved is None else f"place moved by {answer.moved:.3g}"
        lines.append(f"{answer.phrase}: {'same answer' if answer.same else 'ANOTHER ANSWER'}, {place}")
    return lines


Coordinate = Annotated[float, Range(-1e12, 1e12)]
Span = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]


@dataclass(frozen=True)
class Scale:
    """Say how long a scene's unit is, so that answers are in metres: by a known length in it, or by a
    factor. Without either, print what the scene says. Only the header of the .ply is changed."""

    scene: tyro.conf.Positional[Path]
    """The scene, *.ply."""
    metres: Positive | None = None
    """A known length, between the two points of --between."""
    between: Span | None = None
    """Two points that are --metres apart, x y z x y z in world units."""
    metres_per_unit: Positive | None = None
    """How long a unit is."""

    def run(self) -> None:
        if (self.metres is None) != (self.between is None):
            raise InputError(
                "--metres and --between belong together: a length, and the points it lies between"
            )
        if self.metres is not None and self.metres_per_unit is not None:
            raise InputError("give either --metres with --between, or --metres-per-unit")
        factor = self.metres_per_unit
        if self.metres is not None and self.between is not None:
            factor = metres_per_unit(self.metres, self.between)
        if factor is not None:
            write_metres(self.scene, factor)
        stored = load_without_language(self.scene).metres_per_unit
        print(f"{self.scene}: {'no scale' if stored is None else f'{stored:.6g} m per unit'}")


def metres_per_unit(metres: float, between: Span) -> float:
    """Metres per unit of a length in metres between two points. InputError unless both lengths are
    positive."""
    units = math.dist(between[:3], between[3:])
    if not (0 < metres < math.inf and 0 < units < math.inf):
        raise InputError(
            f"{metres:g} m between points {units:g} units apart: both must be above 0 and finite"
        )
    return metres / units
