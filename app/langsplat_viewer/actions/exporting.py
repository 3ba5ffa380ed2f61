"""Writing what is selected, the rest, or the scene without what was deleted: to new files, never over old."""

from collections.abc import Callable
from concurrent.futures import wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.formats import cameras_json, language, save_scene
from langsplat_core.formats.shapes import write_points
from langsplat_core.progress import Progress
from langsplat_core.scene import Scene
from langsplat_viewer.actions.selecting import has_scene, has_selection
from langsplat_viewer.marks.selecting import Marks
from langsplat_viewer.output.saving import free_name
from langsplat_viewer.viewer import Viewer

Part = Literal["selection", "rest", "edited"]
COMPANIONS = (language.SUFFIX, cameras_json.SUFFIX)
LONGEST_WAIT = 60.0  # seconds that a window which is closed waits for what is being written


@dataclass(frozen=True)
class Written:
    """A file that was made."""

    path: Path
    count: int  # Gaussians, or points


def rows_of(marks: Marks, part: Part) -> Array:
    """(N,) bool: what is selected, all else that was not deleted, or all that was not deleted."""
    match part:
        case "selection":
            return marks.selected
        case "rest":
            return marks.kept & ~marks.selected
        case _:
            return marks.kept


def export(
    viewer: Viewer,
    folder: Path,
    part: Part,
    as_points: bool = False,
    then: Callable[[Viewer], None] = lambda viewer: None,
) -> None:
    """Have the worker write a part of the scene to a new file in `folder`: a PLY with its language field and
    cameras, or a point cloud. `then` runs once it is written; if that fails the reason is said."""
    if not (has_scene(viewer) if part == "edited" else has_selection(viewer)):
        return
    state = viewer.state
    scene, marks = state.scene, state.selection.marks
    assert scene is not None
    rows = np.flatnonzero(rows_of(marks, part))
    if len(rows) == 0:
        state.say(f"the {part} holds no Gaussians: nothing to write", is_error=True)
        return
    stem = f"{state.path.stem if state.path else 'scene'}-{part}{'-points' if as_points else ''}"

    def work(progress: Progress) -> Written:
        return _write(scene, rows, folder, stem, as_points)

    def done(written: Written) -> None:
        kind = "points" if as_points else "Gaussians"
        state.say(f"saved {written.path}: {written.count:,} {kind}")
        if part == "edited" and not as_points and state.scene is scene:
            state.selection = replace(state.selection, saved=marks.deleted)
        then(viewer)

    def failed(reason: str) -> None:
        state.say(f"not saved: {reason}", is_error=True)

    job = viewer.worker.submit(f"saving the {part}", work, done, failed)
    state.selection = replace(state.selection, writing=job.future)


def _write(scene: Scene, rows: Array, folder: Path, stem: str, as_points: bool) -> Written:
    """The name is chosen here, one writing after the other, so that no two choose the same."""
    path = free_name(folder, stem, ".ply", () if as_points else COMPANIONS)
    if as_points:
        return Written(path, write_points(path, scene.gaussians.take(rows)))
    save_scene(path, replace(scene.take(rows), path=path))
    return Written(path, len(rows))


def finish_writing(viewer: Viewer) -> None:
    """Wait until what is being written is there: the window closes, and the worker's thread ends with it."""
    writing = viewer.state.selection.writing
    if writing is not None:
        wait([writing], LONGEST_WAIT)
