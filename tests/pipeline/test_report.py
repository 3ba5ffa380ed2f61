"""Quality warnings of a trained scene."""

import json
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array, ViewScore
from langsplat_core.pipeline.report import (
    APART,
    REPORT,
    camera_groups,
    quality_warnings,
    stated_warnings,
    work_folder,
)
from langsplat_core.scene import Camera, look_at

UP = np.array([0.0, 0.0, 1.0])


def ring(count: int, centre=(0.0, 0.0, 0.0)) -> list[Camera]:
    angles = 2 * np.pi * np.arange(count) / count
    middle = np.array(centre)
    eyes = [middle + 3 * np.array([np.cos(a), np.sin(a), 0.3]) for a in angles]
    return [look_at(eye, middle, UP, (64, 48)) for eye in eyes]


def score(psnr: float, covered: float = 0.9) -> ViewScore:
    return ViewScore("view", psnr, 0.8, covered)


def sizes(positions: Array) -> list[int]:
    return [len(group) for group in camera_groups(positions)]


def test_good_scenes_have_no_warning():
    assert quality_warnings([score(27.0), score(14.0)], ring(20)) == ()
    assert quality_warnings([], ring(20)) == ()
    assert quality_warnings([], []) == ()


@pytest.mark.parametrize(
    ("scores", "says"), [([score(12.5), score(14.5)], "at 13.5 dB"), ([score(20, 0.3)], "only 30 %")]
)
def test_a_warning_is_one_sentence_with_a_remedy(scores, says):
    (warning,) = quality_warnings(scores, ring(12))
    assert says in warning
    assert "\n" not in warning
    assert "photograph" in warning.partition(":")[2]


def test_cameras_in_two_groups_are_warned_of():
    (warning,) = quality_warnings([], [*ring(9), *ring(6, (500.0, 0, 0))])
    assert "2 groups far apart (9 and 6 photographs)" in warning


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_cameras_are_grouped_across_wide_gaps_only(factor):
    line = np.zeros((20, 3))
    line[:, 0] = np.arange(20)
    line[10:, 0] += factor * APART - 1
    assert sizes(line) == [20]
    line[10:, 0] += APART
    assert sizes(line) == [10, 10]
    for positions in (np.zeros((0, 3)), np.zeros((1, 3)), np.ones((7, 3)), np.eye(3) * 1e9):
        assert sizes(positions) == [len(positions)]


def test_warnings_are_read_from_the_report_of_this_scene_alone(tmp_path: Path) -> None:
    scene = tmp_path / "s.ply"
    assert stated_warnings(scene, 3) == ()
    report = work_folder(scene) / REPORT
    report.parent.mkdir()
    report.write_text(json.dumps({"gaussians": 3, "warnings": ["dim: look\nagain", 4]}))
    assert stated_warnings(scene, 3) == ("dim: look again",)
    assert stated_warnings(scene, 4) == ()  # of another scene
    wrong = ("[]", "{", '{"gaussians": 3}', '{"gaussians": 3, "warnings": "all"}', "\udcff", "[" * 10_000)
    for text in wrong:
        report.write_bytes(text.encode("utf-8", "surrogateescape"))
        assert stated_warnings(scene, 3) == ()
