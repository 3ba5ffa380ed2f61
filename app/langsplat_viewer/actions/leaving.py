"""Another scene, or none: what was deleted and not saved is asked about first."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from langsplat_viewer.actions.exporting import export
from langsplat_viewer.marks.selecting import Leaving
from langsplat_viewer.viewer import Viewer


def leave(viewer: Viewer, then: Callable[[Viewer], None], to: str) -> None:
    """Do `then`: at once if nothing is lost by it, else when that was answered; `to` says what it is."""
    selection = viewer.state.selection
    if selection.is_unsaved:
        viewer.state.selection = replace(selection, leaving=Leaving(then, to))
    else:
        then(viewer)


def may_close(viewer: Viewer) -> bool:
    """Whether the window may close now; where not, it is asked about."""
    if not viewer.state.selection.may_close:
        quit_viewer(viewer)
    return viewer.state.selection.may_close


def quit_viewer(viewer: Viewer) -> None:
    """Have the window close at the next frame."""
    leave(viewer, _close, "the window closes")


def _close(viewer: Viewer) -> None:
    viewer.state.selection = replace(viewer.state.selection, may_close=True)


def _answered(viewer: Viewer) -> Callable[[Viewer], None] | None:
    leaving = viewer.state.selection.leaving
    viewer.state.selection = replace(viewer.state.selection, leaving=None)
    return None if leaving is None else leaving.then


def save_and_leave(viewer: Viewer, folder: Path) -> None:
    """Write the scene without what was deleted to a new file in `folder`, and go on once it is there."""
    then = _answered(viewer)
    if then is not None:
        export(viewer, folder, "edited", then=then)


def discard_and_leave(viewer: Viewer) -> None:
    """Go on; the file that was opened is as it was."""
    then = _answered(viewer)
    if then is not None:
        then(viewer)


def stay(viewer: Viewer) -> None:
    """Do not go on."""
    _answered(viewer)
