"""Coming back to a scene."""

from dataclasses import replace

from langsplat_core.display.displays import DISPLAYS
from langsplat_core.errors import InputError
from langsplat_core.scene import Scene
from langsplat_viewer.actions.asking import set_canonical
from langsplat_viewer.actions.opening import open_scene
from langsplat_viewer.actions.queries import ask_again
from langsplat_viewer.viewer import Viewer
from langsplat_viewer.visits import Visit, unanswered


def return_to(viewer: Viewer, visit: Visit) -> None:
    """Have it again in the scene that was just opened; what was asked is asked anew."""
    state = viewer.state
    if state.scene is None:
        return
    state.view, state.opening_camera = visit.view or state.view, visit.opening_camera
    count = len(state.scene.cameras)
    if visit.camera_index is not None and visit.camera_index < count:
        state.camera_index = visit.camera_index
    state.seeing = replace(state.seeing, ruler=visit.ruler, clip=visit.clip)
    state.record.keyframes = visit.keyframes
    if state.scene.language is None and DISPLAYS[visit.display].needs_field:
        return
    state.picture = replace(state.picture, display=visit.display)
    state.latent_level = visit.latent_level
    if state.scene.language is None:
        return
    state.queries = [unanswered(query) for query in visit.queries]
    state.selected = None if visit.selected is None else state.queries[visit.selected]
    if visit.canonical:
        set_canonical(viewer, ", ".join(visit.canonical))  # which asks again
    else:
        ask_again(viewer)


def reload(viewer: Viewer) -> None:
    """Read the scene's files again and stay where one is; if that fails the reason is said and the scene is
    kept."""
    state = viewer.state
    path, shown = state.path, state.scene
    if path is None or shown is None:
        state.say("open a scene first; it can be read again when its file has changed", is_error=True)
        return
    if state.opening is not None:
        return
    known = shown.unread

    def check(scene: Scene) -> None:
        new = [reason for reason in scene.unread if reason not in known]
        if new:  # half written, or not written yet
            raise InputError(f"not read again, the scene stays as it was: {new[0]}")

    open_scene(viewer, path, lambda viewer: return_to(viewer, viewer.visits[path.absolute()]), check)


def keep_old(viewer: Viewer) -> None:
    """Do not read what has changed."""
    viewer.watch.dismiss()
