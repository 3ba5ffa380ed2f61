"""Training a scene from photographs, in a process of its own."""

from pathlib import Path

from langsplat_core.pipeline.forecast import count_photographs
from langsplat_core.pipeline.report import work_folder
from langsplat_viewer.actions.opening import open_scene, reload
from langsplat_viewer.files import disk
from langsplat_viewer.files.disk import Stamps
from langsplat_viewer.jobs import one_line
from langsplat_viewer.state import TrainingForm
from langsplat_viewer.viewer import Training, TrainingRequest, Viewer

WARNING = "warning: "  # before each doubt that `langsplat train` ends with


def fill_in(viewer: Viewer, form: TrainingForm) -> None:
    """Take the texts of the form."""
    viewer.state.training_form = form


def start_training(viewer: Viewer) -> None:
    """Train, or go on with what was interrupted: the same photographs and name continue."""
    state, form = viewer.state, viewer.state.training_form
    if viewer.training is not None and viewer.training.exit_code is None:
        viewer.say_error("a training is under way; stop it first")
        return
    dataset = Path(form.dataset.strip()).expanduser()
    out = Path(form.out.strip() or f"{dataset}.ply").expanduser()
    photographs, _ = count_photographs(dataset)
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
    """Interrupt the training; `start_training` goes on from there."""
    if viewer.training is not None:
        viewer.training.interrupt()


def look_at_training(viewer: Viewer) -> None:
    """Open the Gaussians of a training under way, before they have a meaning; while they are still trained,
    as they were at the last checkpoint, and from then on at the next ones."""
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


def _follow(viewer: Viewer, training: Training) -> None:
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
        viewer.say_error(last)
