"""Files: scenes (PLY, compressed PLY, SOG), the language sidecar, cameras, LangSplat's features.

A scene is `scene.ply` with, beside it, `scene.langsplat.safetensors` and `scene.cameras.json`, either of
which may be absent. The same companions are looked for beside a compressed PLY, a SOG folder or a .sog.
"""

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from langsplat_core.errors import InputError
from langsplat_core.files import atomic_path
from langsplat_core.formats import antialiasing, cameras_json, language
from langsplat_core.formats.cameras_json import read_cameras, write_cameras
from langsplat_core.formats.langsplat_features import read_features, write_features
from langsplat_core.formats.language import read_language, rematch_language, write_language
from langsplat_core.formats.opening import exists
from langsplat_core.formats.ply import read_ply, read_ply_scene, write_ply
from langsplat_core.formats.sog import META_NAME, read_sog, read_sog_scene
from langsplat_core.scene import Gaussians, Scene

__all__ = [
    "SUPPORTED",
    "companion_path",
    "load_gaussians",
    "load_scene",
    "load_without_language",
    "read_cameras",
    "read_features",
    "read_language",
    "read_ply",
    "read_ply_scene",
    "read_sog",
    "read_sog_scene",
    "rematch_language",
    "save_scene",
    "write_cameras",
    "write_features",
    "write_language",
    "write_ply",
]

SUPPORTED = ".ply, .compressed.ply, .sog, or a SOG folder or its meta.json"


def load_gaussians(path: Path | str) -> Gaussians:
    """The Gaussians of a scene in any supported format, without its companions.

    Raises InputError for what cannot be opened or is of no supported kind, FormatError for what breaks
    the rules of its format.
    """
    return _read_scene(Path(path)).gaussians


def load_scene(path: Path | str) -> Scene:
    """A scene with its language field and cameras, where they lie beside it.

    Cameras are `<scene>.cameras.json`, or for a PLY in the folder structure of the INRIA code
    (`model/point_cloud/iteration_N/point_cloud.ply`) `model/cameras.json`. Raises InputError and
    FormatError as `load_gaussians` does, also when a companion is unusable or made for other Gaussians.
    """
    scene = load_without_language(path)
    sidecar = companion_path(path, language.SUFFIX)
    if not exists(sidecar):
        return scene
    return replace(scene, language=read_language(sidecar, scene.gaussians.means))


def load_without_language(path: Path | str) -> Scene:
    """As `load_scene`, but without the language field, which is not even looked at."""
    path = Path(path)
    scene, cameras = _read_scene(path), _cameras_path(path)
    return replace(scene, cameras=read_cameras(cameras) if exists(cameras) else (), path=path)


def _read_scene(path: Path) -> Scene:
    """What the scene's own file holds."""
    if not exists(path):
        raise InputError(f"{path}: no such file; check the spelling and the folder")
    if path.suffix.lower() == ".ply" and not path.is_dir():
        return read_ply_scene(path)
    if path.suffix.lower() == ".sog" or path.name == META_NAME or exists(path / META_NAME):
        return read_sog_scene(path)
    if path.is_dir():
        inside = sorted(path.glob("**/*.ply"))
        hint = f"; perhaps {inside[-1]}" if inside else ""
        raise InputError(f"{path}: a folder without {META_NAME} is not a scene{hint}")
    raise InputError(f"{path}: not a scene of a known kind; supported: {SUPPORTED}")


def save_scene(path: Path | str, scene: Scene) -> None:
    """Write `scene` as a .ply with its companions; those it lacks are removed.

    All files are first written whole under temporary names. Then the old companions are removed, the PLY
    renamed into place, and last the new companions. Interrupted anywhere, there is the old scene or the
    new one, perhaps without companions, but never a PLY beside companions of another.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: scenes are written as .ply; choose such a name")
    sidecar, cameras = companion_path(path, language.SUFFIX), companion_path(path, cameras_json.SUFFIX)
    with ExitStack() as renames:  # which it makes in the reverse order of the following lines
        if scene.cameras:
            write_cameras(renames.enter_context(atomic_path(cameras)), scene.cameras)
        if scene.language is not None:
            temporary = renames.enter_context(atomic_path(sidecar))
            write_language(temporary, scene.language, scene.gaussians.means)
        comments = (antialiasing.COMMENT,) if scene.antialiased else ()
        write_ply(renames.enter_context(atomic_path(path)), scene.gaussians, comments, scene.extras)
        for companion in (sidecar, cameras):
            companion.unlink(missing_ok=True)


def companion_path(scene: Path | str, suffix: str) -> Path:
    """Where the file of a scene that ends in `suffix` lies: `a/b.ply` -> `a/b<suffix>`; a SOG folder `a/b`
    (or `a/b/meta.json`) -> `a/b<suffix>`, beside the folder."""
    scene = Path(scene)
    if scene.name == META_NAME:
        scene = scene.parent
    if scene.suffix.lower() in (".ply", ".sog") and not scene.is_dir():
        return scene.with_name(scene.stem + suffix)
    whole = scene.resolve()  # "." has no name of its own
    return whole.with_name(whole.name + suffix)


def _cameras_path(scene: Path) -> Path:
    beside = companion_path(scene, cameras_json.SUFFIX)
    if not exists(beside) and scene.name == "point_cloud.ply":
        return scene.parent.parent.parent / "cameras.json"
    return beside
