"""A long day at the window leaves nothing behind: 50 scenes opened and closed, 1000 actions, memory flat."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.fakes import blob_scene
from tests.support.measured import Measure
from tests.support.on_display import play

COPIES = 40  # of each Gaussian: a scene that is kept is megabytes
MOST_GROWTH = 80.0  # MB; forty scenes that are kept would be some 200
# The scene as it was read, marked, drawn and merged; answers of seven phrases at their levels; pictures of
# the three sizes that moving and resting take.
MOST_ALIVE = {"Scene": 8, "QueryEngine": 1, "QueryResult": 60}
MOST_HELD = MOST_ALIVE | {"texture": 30, "buffer": 8, "framebuffer": 20, "vertexarray": 8, "program": 16}
pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="reads /proc and libGL.so")]


def crowded(scene: Scene, copies: int) -> Scene:
    """With `copies` small ones about each Gaussian."""
    rng = np.random.default_rng(0)
    many = scene.take(np.repeat(np.arange(len(scene.gaussians)), copies))
    means = many.gaussians.means + rng.normal(scale=0.05, size=many.gaussians.means.shape)
    scales = many.gaussians.log_scales - 0.5 * np.log(copies)
    return replace(many, gaussians=replace(many.gaussians, means=means, log_scales=scales))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """With and without a language field, cameras and a phrasebook, of several sizes."""
    scenes = {
        "blobs": crowded(blob_scene(), COPIES),
        "plain": crowded(blob_scene(field=False), COPIES),
        "many": crowded(blob_scene(phrasebook=True), 2 * COPIES),
        "bare": crowded(blob_scene(with_cameras=False), COPIES),
        "few": blob_scene(),
    }
    for name, scene in scenes.items():
        save_scene(tmp_path / f"{name}.ply", replace(scene, path=None))
    return tmp_path


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
def test_fifty_scenes_and_a_thousand_actions(backend: str, display: str, folder: Path, measured: Measure):
    arguments = ["-m", "tests.viewer.soak_driver", backend, str(folder)]
    said = play(display, arguments, folder, timeout=3000).splitlines()
    assert said[-1].endswith("PASSED"), "\n".join(said)[-4000:]
    first, *later = [json.loads(line[line.index("{") :]) for line in said if '"scenes"' in line]
    assert (later[-1]["scenes"], later[-1]["actions"]) == (50, 1000)
    measured(f"soak, {backend}", "MB after 10 scenes and 200 actions", first["MB"])
    measured(f"soak, {backend}", "MB after 50 scenes and 1000 actions", later[-1]["MB"])
    # Forty scenes lie between, each with its answers megabytes.
    assert later[-1]["MB"] - first["MB"] < MOST_GROWTH
    for held in (first, *later):
        for kind, most in MOST_HELD.items():
            assert held[kind] <= most, (kind, held)
