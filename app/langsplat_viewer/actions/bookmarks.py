"""Views with names: kept, listed, gone to."""

from dataclasses import replace

from langsplat_core.errors import InputError
from langsplat_viewer.actions.camera import glide_to
from langsplat_viewer.camera.flight import pose_of, view_of
from langsplat_viewer.files.bookmarks import MOST, Bookmark, named
from langsplat_viewer.jobs import one_line
from langsplat_viewer.viewer import Viewer


def add_bookmark(viewer: Viewer, name: str = "") -> None:
    """Keep the current view; in place of one of the same name. Without a name it gets a number."""
    state = viewer.state
    if state.view is None:
        state.say("open a scene first, then bookmark a view of it", is_error=True)
        return
    kept = state.bookmarks
    if not name.strip():
        number = len(kept) + 1
        while f"view {number}" in {bookmark.name for bookmark in kept}:
            number += 1
        name = f"view {number}"
    added = Bookmark(named(name), pose_of(state.view), state.view.distance)
    others = tuple(bookmark for bookmark in kept if bookmark.name != added.name)
    if len(others) >= MOST:
        state.say(f"a scene has at most {MOST} bookmarks: delete one", is_error=True)
        return
    state.bookmarks, state.bookmark_typed = (*others, added), ""
    _keep(viewer)
    state.say(f"bookmark '{added.name}'")


def type_bookmark(viewer: Viewer, text: str) -> None:
    """What stands in the box for a name."""
    viewer.state.bookmark_typed = text


def go_to_bookmark(viewer: Viewer, bookmark: Bookmark) -> None:
    """Stand where it was made, turning around the same point."""
    if viewer.state.extent is not None:
        view = view_of(bookmark.pose, viewer.state.extent)
        target = view.eye + bookmark.distance * view.rotation[2]
        glide_to(viewer, replace(view, target=target, distance=bookmark.distance))


def delete_bookmark(viewer: Viewer, bookmark: Bookmark) -> None:
    """Take it off the list."""
    viewer.state.bookmarks = tuple(other for other in viewer.state.bookmarks if other is not bookmark)
    _keep(viewer)


def load(viewer: Viewer) -> None:
    """Take those of the scene that was opened."""
    state = viewer.state
    state.bookmarks, state.bookmark_typed = (), ""
    if state.path is None:
        return
    try:
        state.bookmarks = viewer.shelf.read(state.path)
    except InputError as error:
        state.say(str(error), is_error=True)


def _keep(viewer: Viewer) -> None:
    state = viewer.state
    if state.path is None:
        return
    try:
        viewer.shelf.write(state.path, state.bookmarks)
    except (OSError, InputError) as error:
        state.say(f"bookmarks not kept: {one_line(error)}", is_error=True)
