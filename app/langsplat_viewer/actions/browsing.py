"""The file browser, dropped files, recent scenes; and training from photographs."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from langsplat_core.datasets.photos import count_photographs
from langsplat_core.errors import InputError
from langsplat_core.io import cameras, sidecar
from langsplat_core.io.scenes import format_of
from langsplat_core.pipeline.report import work_folder
from langsplat_viewer.actions import projects
from langsplat_viewer.actions.filming import load_path
from langsplat_viewer.actions.opening import add_scenes, open_beside, open_scene, reload
from langsplat_viewer.actions.queries import load_queries
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.files import disk
from langsplat_viewer.files.disk import FolderEntry, Stamps, list_folder
from langsplat_viewer.files.projects import PATHS, PROJECTS, QUERIES, read_project, scene_of
from langsplat_viewer.jobs import one_line
from langsplat_viewer.state import FolderChoice
from langsplat_viewer.viewer import Training, TrainingRequest, Viewer

# The file browser, typed paths, files dropped onto the window, and recent scenes.

COMPANIONS = (cameras.SUFFIX, sidecar.SUFFIX)  # files beside a scene, read with it
NAMED = 3  # files that a message names


def ask_for_file(viewer: Viewer) -> None:
    """Open the browser in the folder of the scene that is shown."""
    state = viewer.state
    browse(viewer, (Path.cwd() if state.path is None else state.path.parent).absolute())
    state.picks_folder, state.picks_beside = None, False


def ask_for_folder(viewer: Viewer, choice: FolderChoice) -> None:
    """Open the browser to choose a folder."""
    ask_for_file(viewer)
    viewer.state.picks_folder = choice


def choose_folder(viewer: Viewer, folder: Path) -> None:
    """Close the browser and give the folder to whoever asked for it."""
    choice, viewer.state.browser = viewer.state.picks_folder, None
    if choice is not None:
        choice.then(viewer, folder)


def ask_for_beside(viewer: Viewer) -> None:
    """Open the browser to choose a scene to show beside this one."""
    ask_for_file(viewer)
    viewer.state.picks_beside = True


def browse(viewer: Viewer, folder: Path) -> None:
    """Show a folder in the browser."""
    viewer.state.browser = list_folder(folder)


def choose(viewer: Viewer, entry: FolderEntry) -> None:
    """Go into a folder, or open a scene."""
    if entry.is_file:
        viewer.state.browser = None
        (open_beside if viewer.state.picks_beside else open_file)(viewer, entry.path)
    else:
        browse(viewer, entry.path)


def open_file(viewer: Viewer, path: Path) -> None:
    """Open a scene or a project, ask a set of queries, or take a camera path."""
    if path.name.endswith(PROJECTS):
        open_project(viewer, path)
    elif path.name.endswith(QUERIES):
        load_queries(viewer, path)
    elif path.name.endswith(PATHS):
        load_path(viewer, path)
    else:
        open_scene(viewer, path)


def open_project(viewer: Viewer, path: Path, then: Callable[[Viewer], None] = lambda viewer: None) -> None:
    """Open the scene of a project, and have in it what the project holds; `then` runs once it is there."""
    try:
        project = read_project(path)
        scene = scene_of(project)
    except InputError as error:
        viewer.say_error(one_line(error))
        return

    def restore(viewer: Viewer) -> None:
        projects.restore(viewer, project, path.absolute())
        then(viewer)

    open_scene(viewer, scene, restore)


def open_dropped(viewer: Viewer, paths: Sequence[Path]) -> None:
    """Open what was dropped onto the window.

    Of scenes the first is opened and all are listed; then sets of queries are asked and paths taken. What
    belongs to a scene lies beside it. A folder of photographs is offered for training. What is none of these
    is said.
    """
    if len(paths) == 1 and _is_plain_folder(paths[0]) and count_photographs(paths[0]):
        choose_photographs(viewer, paths[0])
        open_panel(viewer, "Train")
        return
    sets = [path for path in paths if path.name.endswith((QUERIES, PATHS, PROJECTS))]
    files = [path for path in paths if path not in sets]
    scenes = [path for path in files if not path.name.endswith(COMPANIONS)] or files
    if not scenes:
        _ask_sets(viewer, sets)
        return
    known = [path for path in scenes if format_of(path)] or scenes[:1]
    others = [path.name for path in scenes if path not in known]
    if others:
        more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
        viewer.say_error(f"not opened: {', '.join(others[:NAMED])}{more}")
    add_scenes(viewer, known)
    if len(known) > 1:
        viewer.state.say(f"{len(known)} scenes: the panel Scene lists them")
        open_panel(viewer, "Scene")
    first = known[0]
    open_scene(viewer, first, lambda viewer: _ask_sets(viewer, sets))


def choose_photographs(viewer: Viewer, folder: Path) -> None:
    """Take a folder of photographs, and a name beside it for the scene."""
    form = viewer.state.training_form
    out = form.out or str(folder.with_name(f"{folder.name or 'scene'}.ply"))
    viewer.state.training_form = replace(form, dataset=str(folder), out=out)


def _ask_sets(viewer: Viewer, sets: Sequence[Path]) -> None:
    for path in sets:
        open_file(viewer, path)


def open_recent(viewer: Viewer, path: str) -> None:
    """Open a scene or project of those opened lately."""
    viewer.state.browser = None
    open_file(viewer, Path(path))


def open_typed(viewer: Viewer, text: str) -> None:
    """Go to the folder, or open the scene, of a path: from the folder shown where it is relative."""
    text, listing = text.strip(), viewer.state.browser
    if not text:
        return
    path = (listing.folder if listing else Path.cwd()) / os.path.expanduser(text)
    choose(viewer, FolderEntry(path, is_file=not _is_plain_folder(path)))


def _is_plain_folder(path: Path) -> bool:
    try:
        return path.is_dir() and format_of(path) is None
    except OSError:  # a name that no file system takes: opening it says so
        return False


# Training a scene from photographs, in a process of its own.


def ask_for_dataset(viewer: Viewer) -> None:
    """Open the browser to choose the photographs to train on."""

    def take(viewer: Viewer, folder: Path) -> None:
        viewer.state.training_form = replace(viewer.state.training_form, dataset=str(folder))

    ask_for_folder(viewer, FolderChoice("Photographs to train on", take))


WARNING = "warning: "  # before each warning that `langsplat train` ends with


def start_training(viewer: Viewer) -> None:
    """Train, or go on with what was interrupted: the same photographs and name continue."""
    state, form = viewer.state, viewer.state.training_form
    if viewer.training is not None and viewer.training.exit_code is None:
        viewer.say_error("a training is under way; stop it first")
        return
    dataset = Path(form.dataset.strip()).expanduser()
    out = Path(form.out.strip() or f"{dataset}.ply").expanduser()
    photographs = count_photographs(dataset)
    if not form.dataset.strip() or photographs == 0:
        viewer.say_error(f"no photographs in '{form.dataset.strip()}'; name a folder that has some")
        return
    request = TrainingRequest(dataset, out, form.preset, form.encoder.strip() or "demo")
    try:
        viewer.training = Training(request, viewer.worker.wake)
    except OSError as error:
        viewer.say_error(f"training cannot be started ({one_line(error)})")
        return
    state.say(f"training {out.name} from {photographs} photographs")


def stop_training(viewer: Viewer) -> None:
    """Ask the training under way to stop."""
    if viewer.training is not None:
        viewer.training.interrupt()


def look_at_training(viewer: Viewer) -> None:
    """Open the Gaussians of a training under way, before they have a meaning.

    While they are still trained, as they were at the last checkpoint, and from then on at the next ones.
    """
    training = viewer.training
    if training is None:
        return
    written = disk.newest(training.request.out)
    if not written:
        viewer.state.say("there are no Gaussians to look at yet")
    elif written[0][0].name.endswith(disk.IN_TRAINING):
        _show_checkpoint(viewer, training, written)
    else:
        open_scene(viewer, written[0][0])


def _show_checkpoint(viewer: Viewer, training: Training, checkpoint: Stamps) -> None:
    """Open a checkpoint as a scene, or in place of the one before, where that is still shown."""
    training.previewed = checkpoint
    ((path, _),) = checkpoint

    def done(written: Path) -> None:
        if viewer.state.path == written:
            reload(viewer)
        else:
            open_scene(viewer, written)

    viewer.run("reading the Gaussians so far", lambda progress: disk.write_preview(path), done)


def _follow_checkpoints(viewer: Viewer, training: Training) -> None:
    folder = work_folder(training.request.out)
    if viewer.state.path != folder / disk.PREVIEW or viewer.worker.current is not None:
        return
    written = disk.newest(training.request.out)
    if written != training.previewed and written and written[0][0].name.endswith(disk.IN_TRAINING):
        _show_checkpoint(viewer, training, written)


def watch_training(viewer: Viewer) -> None:
    """Open the scene when its training is finished, or say why there is none; once per frame."""
    training, state = viewer.training, viewer.state
    if training is None:
        return
    if training.exit_code is None:
        _follow_checkpoints(viewer, training)
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
        viewer.say_error(last)
