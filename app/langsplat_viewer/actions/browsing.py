"""Which file is opened: chosen in the browser, typed, dropped onto the window, or open before."""

import os
from collections.abc import Sequence
from pathlib import Path

from langsplat_core.io import cameras, language
from langsplat_core.io.sog import META_NAME
from langsplat_core.pipeline.forecast import count_photographs
from langsplat_viewer.actions.filming import load_path
from langsplat_viewer.actions.opening import add_scenes, open_scene, open_scenes
from langsplat_viewer.actions.queries import load_queries
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.actions.training import choose_photographs
from langsplat_viewer.files.browsing import SUFFIX as QUERIES
from langsplat_viewer.files.browsing import Entry, is_scene, list_folder
from langsplat_viewer.files.flight_files import SUFFIX as PATHS
from langsplat_viewer.viewer import Viewer

COMPANIONS = (cameras.SUFFIX, language.SUFFIX)  # files beside a scene, read with it
NAMED = 3  # files that a message names


def ask_for_file(viewer: Viewer) -> None:
    """Open the browser in the folder of the scene that is shown."""
    state = viewer.state
    folder = state.path.parent if state.path is not None else Path.cwd()
    state.path_typed, state.browser, state.picks_folder = "", list_folder(folder.absolute()), False


def close_browser(viewer: Viewer) -> None:
    """Choose nothing."""
    viewer.state.browser = None


def browse(viewer: Viewer, folder: Path) -> None:
    """Show another folder."""
    viewer.state.path_typed, viewer.state.browser = "", list_folder(folder)


def choose(viewer: Viewer, entry: Entry) -> None:
    """Go into a folder, or open a scene."""
    if entry.is_file:
        close_browser(viewer)
        open_file(viewer, entry.path)
    else:
        browse(viewer, entry.path)


def open_file(viewer: Viewer, path: Path) -> None:
    """Open a scene, ask a set of queries, or take a camera path."""
    if path.name.endswith(QUERIES):
        load_queries(viewer, path)
    elif path.name.endswith(PATHS):
        load_path(viewer, path)
    else:
        open_scene(viewer, path)


def open_dropped(viewer: Viewer, paths: Sequence[Path]) -> None:
    """Open the first scene among files that were dropped onto the window, list the others, ask the queries
    among them, and say what is none of these; what belongs to a scene lies beside it. A folder of photographs
    is offered for training."""
    if len(paths) == 1 and _is_plain_folder(paths[0]) and count_photographs(paths[0])[0]:
        choose_photographs(viewer, paths[0])
        open_panel(viewer, "Train")
        return
    sets = [path for path in paths if path.name.endswith((QUERIES, PATHS))]
    files = [path for path in paths if path not in sets]
    scenes = [path for path in files if not path.name.endswith(COMPANIONS)] or files
    if not scenes:
        _ask_sets(viewer, sets)
        return
    known = [path for path in scenes if is_scene(path)] or scenes[:1]
    others = [path.name for path in scenes if path not in known]
    if others:
        more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
        viewer.state.say(f"not opened: {', '.join(others[:NAMED])}{more}", is_error=True)
    add_scenes(viewer, known)
    if len(known) > 1:
        viewer.state.say(f"{len(known)} scenes: the panel Scene lists them")
        open_panel(viewer, "Scene")
    first = known[0]
    open_scene(viewer, first, lambda viewer: _ask_sets(viewer, sets))


def open_all(viewer: Viewer) -> None:
    """List the scenes of the folder that the browser shows, and open the first."""
    listing = viewer.state.browser
    if listing is not None:
        open_scenes(
            viewer, [entry.path for entry in listing.entries if entry.is_file and is_scene(entry.path)]
        )
        open_panel(viewer, "Scene")


def _ask_sets(viewer: Viewer, sets: Sequence[Path]) -> None:
    for path in sets:
        open_file(viewer, path)


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
    choose(viewer, Entry(path, is_file=not _is_plain_folder(path)))


def _is_plain_folder(path: Path) -> bool:
    try:
        return path.is_dir() and not (path / META_NAME).is_file()
    except OSError:  # a name that no file system takes: opening it says so
        return False
