"""Images and cameras to files, whole or not at all."""

from itertools import count
from pathlib import Path

from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError
from langsplat_core.io.cameras import write_cameras
from langsplat_core.io.files import atomic_path
from langsplat_viewer.camera.controls import with_projection
from langsplat_viewer.jobs import one_line
from langsplat_viewer.viewer import Viewer


def free_name(folder: Path, stem: str, suffix: str, companions: tuple[str, ...] = ()) -> Path:
    """The first of stem-001, stem-002, ... that does not exist in `folder`, nor with the suffixes of files
    that are written beside it."""
    for number in count(1):
        name = f"{stem}-{number:03d}"
        if not any((folder / f"{name}{ending}").exists() for ending in (suffix, *companions)):
            break
    return folder / f"{name}{suffix}"


def save_png(path: Path, image: Array) -> None:
    """Write an (H, W, 3) or (H, W, 4) uint8 image, whole or not at all."""
    with atomic_path(path) as temporary:
        Image.fromarray(image).save(temporary, format="PNG")


def save_picture(viewer: Viewer, folder: Path) -> Path | None:
    """Save the scene as shown, without its background if that was chosen, to a new PNG in `folder`;
    returns its path, None if that failed."""
    state = viewer.state
    if viewer.surface is None or state.scene is None or state.view is None:
        viewer.say_error("open a scene first, then save a picture of it")
        return None
    path = free_name(folder, state.path.stem if state.path else "picture", ".png")
    transparent, beside = state.settings.transparent, viewer.beside
    try:
        images = [viewer.surface.capture(state.request(transparent=transparent))]
        if beside is not None and beside.surface is not None and beside.state.scene is not None:
            images.append(beside.surface.capture(beside.state.request(transparent=transparent)))
        save_png(path, state.settings.split.joined(images, images[0].shape[1]))
    except (OSError, LangSplatError) as error:
        viewer.say_error(f"{path}: not saved ({one_line(error)})")
        return None
    state.say(f"saved {path}")
    return path


def save_view(viewer: Viewer, folder: Path) -> Path | None:
    """Save the current camera, with perspective, to a new file that `--camera` reads; returns its path, None
    if that failed."""
    state = viewer.state
    if state.view is None:
        viewer.say_error("open a scene first, then save a view of it")
        return None
    path = free_name(folder, f"{state.path.stem if state.path else 'view'}-view", ".json")
    try:
        write_cameras(path, (with_projection(state.view, orthographic=False).camera(*state.size),))
    except OSError as error:
        viewer.say_error(f"{path}: not saved ({one_line(error)})")
        return None
    span = f" --orthographic {state.view.span_in(*state.size):.6g}" if state.view.orthographic else ""
    state.say(f"saved {path}; show it again with --camera {path.name}{span}")
    return path
