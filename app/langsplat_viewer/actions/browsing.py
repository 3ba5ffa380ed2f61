"""Training a scene from photographs, in a process of its own."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from langsplat_core.io import cameras, language
from langsplat_core.io.scenes import format_of
from langsplat_core.pipeline.forecast import count_photographs
from langsplat_core.pipeline.report import work_folder
from langsplat_viewer.actions.filming import load_path
from langsplat_viewer.actions.opening import add_scenes, open_scene, open_scenes, reload
from langsplat_viewer.actions.queries import load_queries
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.files import watching
from langsplat_viewer.files.browsing import SUFFIX as QUERIES
from langsplat_viewer.files.browsing import Entry, list_folder
from langsplat_viewer.files.flight_files import SUFFIX as PATHS
from langsplat_viewer.files.watching import Stamps
from langsplat_viewer.jobs import one_line
from langsplat_viewer.state import TrainingForm
from langsplat_viewer.viewer import Training, TrainingRequest, Viewer

WARNING = "warning: "  # before each doubt that `langsplat train` ends with


def fill_in(viewer: Viewer, form: TrainingForm) -> None:
    """What stands in the boxes."""
    viewer.state.training_form = form


def choose_photographs(viewer: Viewer, folder: Path) -> None:
    """Take a folder of photographs, and a name beside it for the scene."""
    form = viewer.state.training_form
    out = form.out or str(folder.with_name(f"{folder.name or 'scene'}.ply"))
    fill_in(viewer, replace(form, dataset=str(folder), out=out))


def start_training(viewer: Viewer) -> None:
    """Train, or go on with what was interrupted: the same photographs and name continue."""
    state, form = viewer.state, viewer.state.training_form
    if viewer.training is not None and viewer.training.exit_code is None:
        state.say("a training is under way; stop it first", is_error=True)
        return
    dataset = Path(form.dataset.strip()).expanduser()
    out = Path(form.out.strip() or f"{dataset}.ply").expanduser()
    photographs, _ = count_photographs(dataset)
    if not form.dataset.strip() or photographs == 0:
        state.say(f"no photographs in '{form.dataset.strip()}'; name a folder that has some", is_error=True)
        return
    request = TrainingRequest(dataset, out, form.preset, form.encoder.strip() or "demo")
    try:
        viewer.training = Training(request, viewer.worker.wake)
    except OSError as error:
        state.say(f"training cannot be started ({one_line(error)})", is_error=True)
        return
    state.say(f"training {out.name} from {photographs} photographs")


def stop_training(viewer: Viewer) -> None:
    """Interrupt; `start_training` goes on from there."""
    if viewer.training is not None:
        viewer.training.interrupt()


def look_at_training(viewer: Viewer) -> None:
    """Open the Gaussians of a training under way, before they have a meaning; while they are still trained,
    as they were at the last checkpoint, and from then on at the next ones."""
    training = viewer.training
    if training is None:
        return
    written = watching.newest(training.request.out)
    if not written:
        viewer.state.say("there are no Gaussians to look at yet")
    elif written[0][0].name.endswith(watching.IN_TRAINING):
        _show_checkpoint(viewer, training, written)
    else:
        open_scene(viewer, written[0][0])


def _show_checkpoint(viewer: Viewer, training: Training, checkpoint: Stamps) -> None:
    """Open it as a scene, or in place of the one before, where that is still shown."""
    training.previewed = checkpoint
    ((path, _),) = checkpoint

    def done(written: Path) -> None:
        if viewer.state.path == written:
            reload(viewer)
        else:
            open_scene(viewer, written)

    viewer.worker.submit(
        "reading the Gaussians so far",
        lambda progress: watching.write_preview(path),
        done,
        lambda reason: viewer.state.say(reason, is_error=True),
    )


def _follow(viewer: Viewer, training: Training) -> None:
    """While its Gaussians are looked at, take the next checkpoint when it is there."""
    folder = work_folder(training.request.out)
    if viewer.state.path != folder / watching.NAME or viewer.worker.current is not None:
        return
    written = watching.newest(training.request.out)
    if written != training.previewed and written and written[0][0].name.endswith(watching.IN_TRAINING):
        _show_checkpoint(viewer, training, written)


def watch_training(viewer: Viewer) -> None:
    """Once per frame: open the scene when it is finished, or say why there is none."""
    training, state = viewer.training, viewer.state
    if training is None:
        return
    if training.exit_code is None:
        _follow(viewer, training)
        return
    viewer.training = None
    last = training.progress.said[-1] if training.progress.said else "no reason given"
    if training.exit_code == 0:
        told = [line for line in training.progress.said if not line.startswith(WARNING)]
        for line in told[-3:]:  # what speaks against the scene is said with it, from its report
            state.say(line)
        open_scene(viewer, training.request.out)
    elif training.interrupted:
        state.say("training stopped; Train goes on where it was")
    else:
        state.say(last, is_error=True)


# Which file is opened: chosen in the browser, typed, dropped onto the window, or open before.

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
    known = [path for path in scenes if format_of(path)] or scenes[:1]
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
            viewer, [entry.path for entry in listing.entries if entry.is_file and format_of(entry.path)]
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
        return path.is_dir() and format_of(path) is None
    except OSError:  # a name that no file system takes: opening it says so
        return False
