"""What selecting costs in the demo scene: printed where this file is run with `--measured`."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io import load_scene
from langsplat_core.query.selection import in_polygon, in_rectangle, in_stroke, on_surface, project
from langsplat_viewer.marks import unmarked
from langsplat_viewer.rendering.request import edited_scene
from tests.support.measured import Measure

DEMO = Path(__file__).parents[2] / "assets" / "demo" / "scene.ply"
SIZE = (1280, 720)
MOST = 1000.0  # milliseconds of one core: far more than it takes, so that only another order of cost fails


def milliseconds(work: Callable[[], object], times: int = 9) -> float:
    """Median of a core's time, which does not grow where others have the cores."""
    taken = []
    for _ in range(times):
        began = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - began))
    return float(np.median(taken))


@pytest.mark.long
def test_selecting_in_the_demo_scene_takes_milliseconds(measured: Measure):
    scene = load_scene(DEMO)
    count, means = len(scene.gaussians), scene.gaussians.means
    tenth = np.random.default_rng(0).uniform(size=count) < 0.1
    marks = unmarked(count)
    first = edited_scene(scene, marks)
    seen = project(means, scene.cameras[0].resized(*SIZE))
    turns = np.linspace(0, 2 * np.pi, 200)
    path = np.stack([640 + 300 * np.cos(turns), 360 + 250 * np.sin(turns)], 1)
    work: dict[str, Callable[[], object]] = {
        "another selection": lambda: edited_scene(scene, replace(marks, selected=tenth), first),
        "hiding": lambda: edited_scene(scene, replace(marks, hidden=tenth)),
        "projection": lambda: project(means, scene.cameras[0].resized(*SIZE)),
        "rectangle": lambda: in_rectangle(seen, path.min(0), path.max(0)),
        "lasso": lambda: in_polygon(seen, path),
        "brush": lambda: in_stroke(seen, path, 0.03 * SIZE[1]),
        "what is visible": lambda: on_surface(seen, np.full(SIZE[::-1], 3.0), SIZE),
    }
    for name, act in work.items():
        taken = milliseconds(act)
        measured("selecting, milliseconds", name, taken)
        assert taken < MOST
