"""Several scenes to switch between. One is in memory at a time; of the others it is known where one stood and
what was asked."""

from collections.abc import Sequence
from pathlib import Path

from langsplat_viewer.actions.opening import open_scene
from langsplat_viewer.actions.visits import return_to
from langsplat_viewer.viewer import Viewer

MOST = 100  # scenes that are listed


def add_scenes(viewer: Viewer, paths: Sequence[Path]) -> None:
    """List scenes, after those that are listed already."""
    listed = viewer.state.scenes
    new = dict.fromkeys(path.absolute() for path in paths)
    viewer.state.scenes = (*listed, *(path for path in new if path not in listed))[:MOST]


def open_scenes(viewer: Viewer, paths: Sequence[Path]) -> None:
    """Open the first of some and list them all."""
    if paths:
        add_scenes(viewer, paths)
        viewer.state.browser = None
        open_scene(viewer, paths[0])


def switch_scene(viewer: Viewer, path: Path) -> None:
    """Show one of the list, as it was left if it was shown before."""
    state = viewer.state
    if state.path is not None and path == state.path.absolute() and state.opening is None:
        return

    def back(viewer: Viewer) -> None:
        if path in viewer.visits:
            return_to(viewer, viewer.visits[path])

    open_scene(viewer, path, back)


def step_scene(viewer: Viewer, by: int) -> None:
    """The next (1) or previous (-1) of the list, beyond its ends from the other one."""
    state = viewer.state
    others = [path for path in state.scenes if state.path is None or path != state.path.absolute()]
    if not others:
        state.say("no other scene is listed: drop several, or open another", is_error=True)
        return
    here = state.scenes.index(state.path.absolute()) if state.path and len(others) < len(state.scenes) else -1
    switch_scene(viewer, state.scenes[(here + by) % len(state.scenes)])


def unlist_scene(viewer: Viewer, path: Path) -> None:
    """Take one off the list, and forget where one stood in it; the one that is shown stays."""
    viewer.state.scenes = tuple(other for other in viewer.state.scenes if other != path)
    viewer.visits.pop(path, None)
