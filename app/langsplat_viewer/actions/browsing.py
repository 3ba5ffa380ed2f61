"""The file browser: where it is, and what is chosen in it."""

import os
from pathlib import Path

from langsplat_core.formats.sog import META_NAME
from langsplat_viewer.actions.opening import open_scene
from langsplat_viewer.browsing import Entry, list_folder
from langsplat_viewer.viewer import Viewer


def ask_for_file(viewer: Viewer) -> None:
    """Open the browser in the folder of the scene that is shown."""
    state = viewer.state
    folder = state.path.parent if state.path is not None else Path.cwd()
    state.path_typed, state.browser = "", list_folder(folder.absolute())


def close_browser(viewer: Viewer) -> None:
    """Choose nothing."""
    viewer.state.browser = None


def browse(viewer: Viewer, folder: Path) -> None:
    """Show another folder."""
    viewer.state.path_typed, viewer.state.browser = "", list_folder(folder)


def choose(viewer: Viewer, entry: Entry) -> None:
    """Go into a folder, or open a scene."""
    if entry.is_scene:
        close_browser(viewer)
        open_scene(viewer, entry.path)
    else:
        browse(viewer, entry.path)


def open_recent(viewer: Viewer, path: str) -> None:
    """Open a scene again that was open before."""
    close_browser(viewer)
    open_scene(viewer, Path(path))


def type_path(viewer: Viewer, text: str) -> None:
    """What stands in the box for a path."""
    viewer.state.path_typed = text


def open_typed(viewer: Viewer) -> None:
    """Go to the folder, or open the scene, that the box names: from the folder shown where it is relative."""
    text, listing = viewer.state.path_typed.strip(), viewer.state.browser
    if not text:
        return
    path = (listing.folder if listing else Path.cwd()) / os.path.expanduser(text)
    choose(viewer, Entry(path, is_scene=not _is_plain_folder(path)))


def _is_plain_folder(path: Path) -> bool:
    try:
        return path.is_dir() and not (path / META_NAME).is_file()
    except OSError:  # a name that no file system takes: opening it says so
        return False
