"""Training a scene from photographs, in a process of its own."""

from dataclasses import replace
from pathlib import Path

from langsplat_core.pipeline.forecast import count_photographs
from langsplat_viewer.actions.opening import open_scene
from langsplat_viewer.jobs import one_line
from langsplat_viewer.state import TrainingForm
from langsplat_viewer.training import Training, TrainingRequest
from langsplat_viewer.viewer import Viewer


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
    """Open the Gaussians that a training under way has finished, before they have a meaning."""
    training = viewer.training
    if training is None:
        return
    work = training.request.out.with_name(f"{training.request.out.stem}.work")
    finished = sorted(work.glob("radiance-*.ply"), key=lambda path: path.stat().st_mtime)
    if finished:
        open_scene(viewer, finished[-1])
    else:
        viewer.state.say("the Gaussians are not trained yet")


def watch_training(viewer: Viewer) -> None:
    """Once per frame: open the scene when it is finished, or say why there is none."""
    training, state = viewer.training, viewer.state
    if training is None or training.exit_code is None:
        return
    viewer.training = None
    last = training.progress.said[-1] if training.progress.said else "no reason given"
    if training.exit_code == 0:
        for line in training.progress.said[-3:]:
            state.say(line)
        open_scene(viewer, training.request.out)
    elif training.interrupted:
        state.say("training stopped; Train goes on where it was")
    else:
        state.say(last, is_error=True)
