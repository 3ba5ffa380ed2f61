"""The photograph of the training camera at which one stands, laid over the picture."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress
from langsplat_core.scene import Camera
from langsplat_viewer.actions.history import remember
from langsplat_viewer.files import photographs
from langsplat_viewer.files.browsing import list_folder
from langsplat_viewer.files.photographs import Photograph
from langsplat_viewer.files.preferences import with_photographs
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer

SAME = 1e-6  # of the scene's radius, and of a rotation: nearer is the same place


def standing_at(state: ViewerState) -> Camera | None:
    """The training camera whose pose the view has, whatever its field of view; None elsewhere, and without
    perspective."""
    scene, view, index = state.scene, state.view, state.camera_index
    if (
        scene is None
        or view is None
        or view.back
        or state.extent is None
        or index is None
        or state.glide is not None
    ):
        return None
    camera = scene.cameras[index]
    is_there = np.abs(view.eye - camera.position).max() <= SAME * state.extent.radius
    return camera if is_there and np.abs(view.rotation - camera.rotation).max() <= SAME else None


def photograph_here(state: ViewerState) -> Photograph | None:
    """That of the camera at which one stands, as far as it was looked for."""
    photograph = state.photograph
    return photograph if photograph is not None and photograph.camera is standing_at(state) else None


def fade_photograph(viewer: Viewer, fade: float) -> None:
    """How much of the photograph is laid over the picture, 0 to 1."""
    fade = min(max(fade, 0.0), 1.0)
    if fade != viewer.state.seeing.fade:
        remember(viewer, "fade")
        viewer.state.seeing = replace(viewer.state.seeing, fade=fade)


def fetch_photograph(viewer: Viewer) -> None:
    """Once per frame: have the worker look for the photograph that is wanted now and was not looked for."""
    state = viewer.state
    camera = standing_at(state) if state.seeing.fade > 0 else None
    if camera is None or state.path is None:
        return
    path, folder = state.path, _folder(viewer)
    before = state.photograph
    if before is not None and before.camera is camera and before.folder == folder:
        return
    wanted = state.photograph = Photograph(camera, folder)

    def work(progress: Progress) -> Array:
        return photographs.read(photographs.find(camera.name, path, folder), camera)

    def done(image: Array) -> None:
        if state.photograph is wanted:
            state.photograph = replace(wanted, image=image)

    def failed(reason: str) -> None:
        if state.photograph is wanted:
            state.photograph = replace(wanted, reason=reason)

    viewer.worker.submit(f"reading the photograph {camera.name}", work, done, failed)


def _folder(viewer: Viewer) -> str:
    path = viewer.state.path
    return "" if path is None else viewer.state.preferences.photographs.get(str(path.absolute()), "")


def ask_for_photographs(viewer: Viewer) -> None:
    """Open the browser to choose the folder that has the photographs of the scene."""
    state = viewer.state
    if state.path is not None:
        start = Path(_folder(viewer) or state.path.parent)
        state.path_typed, state.browser, state.picks_folder = "", list_folder(start.absolute()), True


def choose_photograph_folder(viewer: Viewer, folder: Path) -> None:
    """Look for the photographs of this scene there from now on; remembered."""
    state = viewer.state
    state.browser = None
    if state.path is not None:
        state.preferences = with_photographs(state.preferences, state.path.absolute(), folder.absolute())
