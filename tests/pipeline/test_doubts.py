"""A scene that nobody wants to see is said to be one."""

import json
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.pipeline.report import APART, REPORT, camera_groups, doubts, stated_doubts, work_folder
from langsplat_core.scene import Camera, look_at
from langsplat_core.training.radiance.train import ViewScore

UP = np.array([0.0, 0.0, 1.0])


def ring(count: int, centre=(0.0, 0.0, 0.0)) -> list[Camera]:
    angles = 2 * np.pi * np.arange(count) / count
    middle = np.array(centre)
    eyes = [middle + 3 * np.array([np.cos(a), np.sin(a), 0.3]) for a in angles]
    return [look_at(eye, middle, UP, (64, 48)) for eye in eyes]


def score(psnr: float, covered: float = 0.9) -> ViewScore:
    return ViewScore("view", psnr, 0.8, covered)


def test_nothing_is_said_of_a_good_scene():
    assert doubts([score(27.0), score(14.0)], ring(20)) == ()
    assert doubts([], ring(20)) == ()
    assert doubts([], []) == ()


@pytest.mark.parametrize(
    ("scores", "says"), [([score(12.5), score(14.5)], "at 13.5 dB"), ([score(20, 0.3)], "only 30 %")]
)
def test_what_speaks_against_it_is_one_sentence_with_a_remedy(scores, says):
    (doubt,) = doubts(scores, ring(12))
    assert says in doubt
    assert "\n" not in doubt
    assert "photograph" in doubt.partition(":")[2]


def test_two_groups_of_cameras():
    (doubt,) = doubts([], [*ring(9), *ring(6, (500.0, 0, 0))])
    assert "2 groups far apart (9 and 6 photographs)" in doubt


def test_a_single_stray_camera_is_no_group():
    assert camera_groups(np.array([c.position for c in [*ring(9), *ring(1, (500.0, 0, 0))]])) == (9,)


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_a_wide_step_is_not_yet_a_gap(factor):
    line = np.zeros((20, 3))
    line[:, 0] = np.arange(20)
    line[10:, 0] += factor * APART - 1
    assert camera_groups(line) == (20,)
    line[10:, 0] += APART
    assert camera_groups(line) == (10, 10)


@pytest.mark.parametrize("positions", [np.zeros((0, 3)), np.zeros((1, 3)), np.ones((7, 3)), np.eye(3) * 1e9])
def test_positions_that_say_nothing(positions):
    assert camera_groups(positions) == (len(positions),)


def test_a_report_beside_a_scene_says_its_doubts_and_a_strange_one_nothing(tmp_path: Path) -> None:
    scene = tmp_path / "s.ply"
    assert stated_doubts(scene, 3) == ()
    report = work_folder(scene) / REPORT
    report.parent.mkdir()
    report.write_text(json.dumps({"gaussians": 3, "doubts": ["dim: look\nagain", 4]}))
    assert stated_doubts(scene, 3) == ("dim: look again",)
    assert stated_doubts(scene, 4) == ()  # of another scene, or of an earlier state of it
    for text in ("[]", "{", '{"gaussians": 3}', '{"gaussians": 3, "doubts": "all"}', "\udcff", "[" * 10_000):
        report.write_bytes(text.encode("utf-8", "surrogateescape"))
        assert stated_doubts(scene, 3) == ()
