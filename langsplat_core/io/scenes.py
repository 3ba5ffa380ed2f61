"""Scenes on disk: formats and companion files.

`formats()` is the table behind the loader, `langsplat convert`, file dialogs and the desktop entry. A scene
is `scene.ply`, a compressed PLY or a SOG folder with the optional companions `scene.langsplat.safetensors`
and `scene.cameras.json` beside it. Those of other formats keep the suffix, `scene.spz.cameras.json`: a
sidecar belongs to the rounded positions of that file, not to a `scene.ply` in the same folder.
"""

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from msgspec import Meta, Struct

from langsplat_core import registry
from langsplat_core.arrays import Array
from langsplat_core.config import CodecConfig
from langsplat_core.errors import STRICTNESS, InputError, LangSplatError, expect, report_loss
from langsplat_core.io import cameras as camera_files
from langsplat_core.io import sidecar as language_files
from langsplat_core.io.files import atomic_path, check_output_file, locked, shown, write_json
from langsplat_core.io.gltf import read_gltf_scene, write_gltf
from langsplat_core.io.hostile import decode_json, read_file
from langsplat_core.io.ply import read_ply_scene, write_ply
from langsplat_core.io.quantised import read_splat_scene, write_splat
from langsplat_core.io.sog import META_NAME, read_sog_scene, write_sog
from langsplat_core.io.spz import read_spz_scene, write_spz
from langsplat_core.progress import Progress, WorkCancelledError
from langsplat_core.scene import LEVELS, Gaussians, LanguageField, Scene, about_origin

log = logging.getLogger("langsplat")

# Parts of a scene that a format may lack: each loss is reported in a line. A companion keeps the origin and
# metres per unit for formats without an origin. `langsplat convert` reports how numbers are rounded.
PARTS: Mapping[str, Callable[[Scene], object]] = MappingProxyType({
    "view dependence": lambda scene: scene.gaussians.sh[:, 1:].any(),
    "antialiasing": lambda scene: scene.antialiased,
    "metres per unit": lambda scene: scene.metres_per_unit is not None,
    "extra properties": lambda scene: scene.extras,
    "cameras": lambda scene: scene.cameras,
    "taught words": lambda scene: scene.language is not None and scene.language.taught,
})  # fmt: skip
LOSSES = ("precision", "view dependence", "antialiasing", "extra properties", "origin")
ORIGIN_SUFFIX = ".origin.json"  # of the companion with origin and scale, for formats without an origin


Reader = Callable[[Path], Scene]
Writer = Callable[[Path, Scene], None]


@dataclass(frozen=True)
class SceneFormat:
    """A format of scenes: one row of `formats()`."""

    suffix: str  # of its files, lower case; also its name in messages
    read: Reader
    write: Writer | None = None  # None: read only
    loses: tuple[str, ...] = ()  # what its files cannot hold, of `LOSSES` or `PARTS`
    rounds: str = ""  # description of how numbers are rounded
    own_companions: bool = False  # companions keep the suffix: `a.spz.langsplat.safetensors`
    folder_file: str = ""  # this file, or a folder that has it, is a scene of the format too
    mime: str = "model/x-gaussian-splat"


SMALL = ("precision", "extra properties", "origin")
GLTF = ("precision", "extra properties")
ROUNDS = MappingProxyType({
    ".spz": "positions to 1/4096 unit or finer, sizes to 3 %, rotations to 0.2 degrees, colours to 1/255",
    ".splat": "rotations to a degree, colours and opacities to 1/255",
    ".sog": "positions to 1/65535 of the extent, rotations to a degree, all else to 256 values each",
})  # fmt: skip
CORE_FORMATS = (
    SceneFormat(".ply", read_ply_scene, write_ply, mime="model/x-ply"),  # plain and compressed
    SceneFormat(".spz", read_spz_scene, write_spz, SMALL, ROUNDS[".spz"], own_companions=True),
    SceneFormat(".splat", read_splat_scene, write_splat, LOSSES, ROUNDS[".splat"], own_companions=True),
    SceneFormat(
        ".sog", read_sog_scene, write_sog, SMALL, ROUNDS[".sog"], own_companions=True, folder_file=META_NAME
    ),
    SceneFormat(".glb", read_gltf_scene, write_gltf, GLTF, own_companions=True, mime="model/gltf-binary"),
    SceneFormat(".gltf", read_gltf_scene, write_gltf, GLTF, own_companions=True, mime="model/gltf+json"),
)


def formats() -> tuple[SceneFormat, ...]:
    """Return all scene formats: the core's, then those of extensions."""
    return (*CORE_FORMATS, *registry.parts("formats").values())


def writable_suffixes() -> tuple[str, ...]:
    """Return the suffixes of the formats that can be written."""
    return tuple(row.suffix for row in formats() if row.write is not None)


def format_of(path: Path) -> SceneFormat | None:
    """Return the format of `path` by its name or, for a folder, by the file in it; None if it is no scene."""
    folder = os.path.isdir(path)  # False for a name that is too long, where `Path.is_dir` raises
    for row in formats():
        if not folder and path.suffix.lower() == row.suffix:
            return row
        if row.folder_file and (path.name == row.folder_file or os.path.exists(path / row.folder_file)):
            return row
    return None


# ---- reading ----


class PlacedOrigin(Struct):
    """Content of the companion with origin and scale."""

    origin: tuple[camera_files.Coordinate, camera_files.Coordinate, camera_files.Coordinate]
    metres_per_unit: Annotated[float, Meta(gt=0, le=1e12)] | None = None


def load_scene(path: Path | str, read: Reader | None = None) -> Scene:
    """Return a scene with its language field and cameras, if they are beside it.

    Cameras are `<scene>.cameras.json`, or for a PLY in folders as of the INRIA code
    (`model/point_cloud/iteration_N/point_cloud.ply`) `model/cameras.json`. A companion that is unusable or of
    other Gaussians is left out, with the reason in `Scene.unread`. read: in place of the format's reader.
    Raises InputError for a file that cannot be opened or is of no known kind, FormatError for a damaged one.
    """
    scene = load_without_language(path, read)
    sidecar = companion_path(path, language_files.SUFFIX)
    if not os.path.exists(sidecar):
        return scene
    try:
        language = language_files.read_language(sidecar, scene.gaussians.means, scene.origin)
        return replace(scene, language=language)
    except InputError as error:
        if STRICTNESS.on:
            raise
        return replace(scene, unread=(*scene.unread, str(error)))


def load_without_language(path: Path | str, read: Reader | None = None) -> Scene:
    """Return a scene as `load_scene` does, without reading its language field."""
    expect(path, str | os.PathLike, "name the file of a scene")
    path = Path(path)
    scene, cameras = replace(_read(path, read), path=path), _cameras_path(path)
    if not os.path.exists(cameras):
        return scene
    try:
        found = camera_files.read_cameras(cameras)
        return replace(scene, cameras=tuple(camera.moved(-scene.origin) for camera in found))
    except InputError as error:
        report_loss("opened without its cameras: %s", error)
        return replace(scene, unread=(*scene.unread, str(error)))


def _read(path: Path, read: Reader | None = None) -> Scene:
    """Return the content of the scene's own file, and report rows that cannot be drawn."""
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file; check the spelling and the folder")
    if (row := format_of(path)) is None and path.is_dir():
        levels = (list(path.glob(f"{'*/' * depth}*.ply")) for depth in range(3))  # INRIA's lies two deeper
        inside: list[Path] = next(filter(None, levels), [])
        hint = f"; perhaps {max(inside, key=lambda file: (len(str(file)), file))}" if inside else ""
        raise InputError(f"{path}: a folder without {META_NAME} is not a scene{hint}")
    if row is None:
        kinds = ", ".join(row.suffix for row in formats())
        raise InputError(f"{path}: not a scene of a known kind; supported: {kinds}, {META_NAME}")
    with failures("formats", row.suffix):
        found = (read or row.read)(path)
        if not isinstance(found, Scene):
            raise TypeError(f"it returns a {type(found).__name__}, no Scene")
    scene = _about_origin(path, found)
    log.debug("%s: %d Gaussians", path, len(scene.gaussians))
    warn_of_undrawable(path, scene.gaussians)
    return scene


def _about_origin(path: Path, scene: Scene) -> Scene:
    """Return the scene about the origin beside it, or one near it; rounded positions are reported."""
    try:
        named = read_origin(path)
    except InputError as error:
        report_loss("opened without its origin: %s", error)
        return replace(scene, unread=(str(error),))
    if named is not None:
        metres = named.metres_per_unit or scene.metres_per_unit
        return replace(scene, origin=scene.origin + named.origin, metres_per_unit=metres)
    if not scene.origin.any():
        means, origin = about_origin(scene.gaussians.means)
        if not origin.any():
            return scene
        scene = replace(scene, gaussians=replace(scene.gaussians, means=means), origin=origin)
    world = scene.in_world(scene.gaussians.means[:: len(scene.gaussians) // 4096 + 1])
    with np.errstate(over="ignore"):
        single = world.astype(np.float32)
    if ((single == world) | ~np.isfinite(world)).all():
        step = np.spacing(np.abs(scene.origin).max(), dtype=np.float32)
        what = "as float32 holds them so far from zero; export them as double, or about an origin near them"
        report_loss("%s: positions were rounded to steps of %g units, %s", path, step, what)
    return scene


def read_origin(path: Path) -> PlacedOrigin | None:
    """Return the content of a file's origin companion; None without one. InputError if it is damaged."""
    beside = companion_path(path, ORIGIN_SUFFIX)
    return decode_json(read_file(beside, 1 << 16), PlacedOrigin, beside) if os.path.exists(beside) else None


def write_origin(path: Path, origin: Array, metres_per_unit: float | None = None) -> None:
    """Write an origin (3,) and scale as the companion `path` of a file in a format without an origin."""
    scale = {} if metres_per_unit is None else {"metres_per_unit": metres_per_unit}
    write_json(path, {"origin": origin.tolist(), **scale})


def warn_of_undrawable(path: Path, gaussians: Gaussians) -> None:
    """Report how many of the Gaussians that were read from `path` cannot be drawn, and why."""
    if reasons := gaussians.invalid_rows():
        share = f"{sum(reasons.values())} of the {len(gaussians)} Gaussians"
        report_loss("%s: %s cannot be drawn (%s); is the file damaged?", path, share, ", ".join(reasons))


# ---- writing ----


def check_writable(path: Path | str, *sources: Path) -> SceneFormat:
    """Raise InputError unless `save_scene` can write a scene and its companions at `path`.

    None of these files may belong to the scenes `sources`.
    """
    path = Path(path)
    for row in formats():
        if row.suffix == path.suffix.lower() and row.write is not None:
            for file in (path, *_companions(path)):
                check_output_file(file)
            check_keeps(path, *sources)
            return row
    raise InputError(f"{path}: scenes are written as {', '.join(writable_suffixes())}; choose such a name")


def check_keeps(out: Path, *sources: Path) -> None:
    """Raise InputError if writing `out`, or a companion of it, would replace a file of `sources`."""
    read = {file.resolve() for source in sources for file in (source, *scene_files(source))}
    companions = _companions(out) if out.suffix.lower() in writable_suffixes() else ()
    for path in (out, *companions):
        if path.resolve() in read and (path == out or os.path.exists(path)):
            what = "would replace" if path == out else f"its {shown(Path(path.name))} would replace that of"
            raise InputError(f"{shown(out)}: {what} the original scene; choose another name")


def report_left_out(path: Path, scene: Scene, kind: str, loses: Sequence[str], keeper: str) -> None:
    """Report each part of a scene that files of a `kind` lose, and what the companion `keeper` keeps."""
    kept = [f"the origin {' '.join(f'{value:.10g}' for value in scene.origin)}"] if scene.origin.any() else []
    if "metres per unit" not in loses and scene.metres_per_unit is not None:
        kept.append(f"{scene.metres_per_unit:g} metres per unit")
    for what in kept if "origin" in loses else ():
        log.warning("%s: %s have no room for %s, which %s keeps", shown(path), kind, what, keeper)
    for what in loses:
        if what in PARTS and PARTS[what](scene):
            report_loss("%s: %s have no room for %s", shown(path), kind, what)


def save_scene(path: Path | str, scene: Scene, tell: bool = True, write: Writer | None = None) -> None:
    """Write `scene` in the format of its name, with its companions; old ones it lacks are removed and named.

    Only the PLY keeps everything: see `SceneFormat.loses`. All formats keep the order of rows. Files are
    written under temporary names; then old companions are removed, and the scene and last the new companions
    renamed into place. An interruption leaves the old scene or the new one, perhaps without companions, never
    with those of another. InputError as of `check_writable`, and for companions that could not be read, which
    would be removed. tell: report what the format loses (`report_left_out`). write: in place of its writer.
    """
    expect(path, str | os.PathLike, "say save_scene(path, scene)")
    expect(scene, Scene, "Scene(gaussians) makes one")
    path = Path(path)
    if scene.unread:
        raise InputError(f"not written without what lies beside it; mend or remove that: {scene.unread[0]}")
    row = check_writable(path)
    write = write or row.write
    assert write is not None
    sidecar, cameras, origin = _companions(path)
    if tell:
        report_left_out(path, scene, f"{row.suffix} files", row.loses, origin.name)
    for file, new in ((sidecar, scene.language), (cameras, scene.cameras or None)):
        if new is None and os.path.exists(file):
            report_loss("%s: removes %s of the scene that was there", shown(path), shown(Path(file.name)))
    path.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as lock, ExitStack() as renames, failures("formats", row.suffix):
        # Renames happen in the reverse order of these lines.
        if scene.cameras:
            in_world = tuple(camera.moved(scene.origin) for camera in scene.cameras)
            camera_files.write_cameras(renames.enter_context(atomic_path(cameras)), in_world)
        known = bool(scene.origin.any()) or scene.metres_per_unit is not None
        if beside := "origin" in row.loses and known:
            write_origin(renames.enter_context(atomic_path(origin)), scene.origin, scene.metres_per_unit)
        new_sidecar = None if scene.language is None else renames.enter_context(atomic_path(sidecar))
        new_file = renames.enter_context(atomic_path(path))
        write(new_file, scene)
        if scene.language is not None and new_sidecar is not None:
            # The sidecar belongs to the positions as they are read back: rounded, or with another origin.
            again = row.read(new_file) if "precision" in row.loses or scene.origin.any() else scene
            if beside:
                again = replace(again, origin=scene.origin + again.origin)
            language_files.write_language(new_sidecar, scene.language, again.gaussians.means, again.origin)
        # Locked, else two processes that write one scene could mix their files.
        lock.enter_context(locked(path.parent))
        for companion in (sidecar, cameras, origin):
            companion.unlink(missing_ok=True)


# ---- the files of a scene ----


def companion_path(scene: Path | str, suffix: str) -> Path:
    """Return the path of the companion of a scene that ends in `suffix`: `a/b.ply` -> `a/b<suffix>`.

    A SOG folder `a/b` (or `a/b/meta.json`) -> `a/b<suffix>`, beside the folder; `a/b.spz`, .sog or
    .splat -> `a/b.spz<suffix>` and so on. A symbolic link has its target's, if only that exists.
    """
    scene = Path(scene)
    if any(scene.name == row.folder_file for row in formats()):
        scene = scene.parent
    row = None if os.path.isdir(scene) else format_of(scene)
    if row is None:
        scene = Path(os.path.abspath(scene))  # "." has no name of its own
    beside = scene.with_name((scene.stem if row and not row.own_companions else scene.name) + suffix)
    linked = os.path.islink(scene) and not os.path.lexists(beside)
    there = companion_path(os.path.realpath(scene), suffix) if linked else beside
    return there if os.path.exists(there) else beside


def scene_files(path: Path | str) -> tuple[Path, ...]:
    """Return the files that `load_scene` reads if they exist: scene, language field, cameras, origin."""
    path = Path(path)
    own: tuple[Path, ...] = (path,)
    if os.path.isdir(path) or path.name == META_NAME:
        folder = path if os.path.isdir(path) else path.parent
        own = (folder / META_NAME, *sorted(folder.glob("*.webp")))
    sidecar, _, origin = _companions(path)
    beside = (origin,) if os.path.exists(origin) else ()
    return (*own, sidecar, _cameras_path(path), *beside)


def _companions(path: Path) -> tuple[Path, Path, Path]:
    suffixes = (language_files.SUFFIX, camera_files.SUFFIX, ORIGIN_SUFFIX)
    sidecar, cameras, origin = (companion_path(path, suffix) for suffix in suffixes)
    return sidecar, cameras, origin


def _cameras_path(scene: Path) -> Path:
    beside = companion_path(scene, camera_files.SUFFIX)
    real = Path(os.path.realpath(scene))
    if not os.path.exists(beside) and real.name == "point_cloud.ply":
        return real.parent.parent.parent / "cameras.json"
    return beside


# ---- scenes of several files of other programs: parts of extensions for `langsplat convert` ----


@dataclass(frozen=True)
class ImportRequest:
    """Files of another method for one scene, with settings that they do not contain."""

    paths: tuple[Path, ...]
    encoder: str | None  # hub id or folder of the text encoder of the vectors; None: the method's own
    levels: tuple[str, ...]  # of the feature files, in order; empty: from names of files and folders
    phrases: tuple[str, ...]  # to encode and store
    codec: CodecConfig  # for whole vectors


@dataclass(frozen=True)
class Importer:
    """A reader of scenes in files of another method."""

    suffixes: tuple[str, ...]  # lower case, of files in no scene format
    read: Callable[[ImportRequest, Progress], tuple[Scene, tuple[str, ...]]]  # with lines to print


@dataclass(frozen=True)
class Exporter:
    """A writer of files for another program: a value of `langsplat convert --to`."""

    write: Callable[[Scene, Path, Progress], tuple[str, ...]]  # into a folder; returns lines to print
    loses: tuple[str, ...] = ()  # as in `SceneFormat`


@contextmanager
def failures(kind: registry.Kind, name: str) -> Iterator[None]:
    """Turn whatever a reader or writer of an extension raises into one line that names the extension."""
    try:
        yield
    except (LangSplatError, WorkCancelledError, OSError, MemoryError):
        raise
    except Exception as error:
        if (where := registry.references(kind).get(name)) is None:
            raise
        what = f"extension's {where} fails ({type(error).__name__}: {error})"
        raise InputError(f"{name}: its {what}; mend or remove that") from error


# Figures of a scene.


def summarise(scene: Scene) -> dict[str, Any]:
    """Return the figures of a scene, which may be empty, ready for JSON."""
    gaussians = scene.gaussians
    valid = gaussians.valid()
    means = gaussians.means[valid] if valid.any() else np.zeros((1, 3))
    return {
        "gaussians": len(gaussians),
        "invalid": gaussians.invalid_rows(),  # reason -> rows, each under its first
        "invalid_rows": int((~valid).sum()),
        "bounds": scene.in_world(np.quantile(means, [0.01, 0.99], axis=0)).tolist(),  # in the world
        "origin": scene.origin.tolist(),  # of the means in memory, in the world
        "sh_degree": gaussians.sh_degree,
        "antialiased": scene.antialiased,
        "metres_per_unit": scene.metres_per_unit,
        "extras": list(scene.extras),
        "cameras": len(scene.cameras),
        "memory_bytes": memory_bytes(scene),
        "language": None if scene.language is None else _language(scene.language),
    }


def memory_bytes(scene: Scene) -> int:
    """Return the bytes in memory of the arrays that grow with the number of Gaussians."""
    arrays = [getattr(scene.gaussians, field.name) for field in fields(scene.gaussians)]
    own = sum(array.nbytes for array in (*arrays, *scene.extras.values()))
    return own + (0 if scene.language is None else _bytes(scene.language))


def disk_bytes(scene: Path) -> int:
    """Return the size of a scene file, or of a folder's files, with the companions beside it."""
    return sum(file.stat().st_size for file in scene_files(scene) if file.is_file())


def _bytes(field: LanguageField) -> int:
    leaves: tuple[Array, ...] = () if field.tree is None else (field.tree.leaves,)
    return sum(array.nbytes for array in (field.latents, field.confidence, *leaves))


def _language(field: LanguageField) -> dict[str, Any]:
    shares = (field.confidence > 0).mean(axis=1) if len(field) else np.zeros(len(LEVELS))
    nodes = None if field.tree is None else [int((field.tree.levels == n).sum()) for n in range(len(LEVELS))]
    return {
        "codec": field.codec.kind,
        "size": field.codec.size,  # codewords of a codebook, numbers per latent of other kinds
        "encoder": field.encoder_id,
        "vector_dim": field.codec.vector_dim,
        "phrases": len(field.phrasebook),
        "taught": [word.name for word in field.taught],
        "observed": dict(zip(LEVELS, shares.tolist(), strict=True)),  # share of the Gaussians with a feature
        "nodes": nodes,  # of the tree, at each level; None without a tree
        "calibrated": field.calibration is not None,  # answers have probabilities
        "bytes": _bytes(field),  # latents, confidences and leaves of the tree
    }
