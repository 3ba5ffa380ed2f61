"""Quality warnings of a trained scene, and the forecast of what a training costs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array, ViewScore
from langsplat_core.config import PAPER, MaskConfig, TrainConfig, with_preset
from langsplat_core.pipeline.forecast import Forecast, Stage, count_photographs, forecast_in_words, plan
from langsplat_core.pipeline.report import (
    APART,
    REPORT,
    camera_groups,
    quality_warnings,
    stated_warnings,
    work_folder,
)
from langsplat_core.progress import ALL_STAGES, Progress, Report
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


def test_nothing_is_said_of_a_good_scene():
    assert quality_warnings([score(27.0), score(14.0)], ring(20)) == ()
    assert quality_warnings([], ring(20)) == ()
    assert quality_warnings([], []) == ()


@pytest.mark.parametrize(
    ("scores", "says"), [([score(12.5), score(14.5)], "at 13.5 dB"), ([score(20, 0.3)], "only 30 %")]
)
def test_what_speaks_against_it_is_one_sentence_with_a_remedy(scores, says):
    (warning,) = quality_warnings(scores, ring(12))
    assert says in warning
    assert "\n" not in warning
    assert "photograph" in warning.partition(":")[2]


def test_two_groups_of_cameras():
    (warning,) = quality_warnings([], [*ring(9), *ring(6, (500.0, 0, 0))])
    assert "2 groups far apart (9 and 6 photographs)" in warning


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_a_wide_step_is_not_yet_a_gap(factor):
    line = np.zeros((20, 3))
    line[:, 0] = np.arange(20)
    line[10:, 0] += factor * APART - 1
    assert sizes(line) == [20]
    line[10:, 0] += APART
    assert sizes(line) == [10, 10]
    for positions in (np.zeros((0, 3)), np.zeros((1, 3)), np.ones((7, 3)), np.eye(3) * 1e9):
        assert sizes(positions) == [len(positions)]


def test_a_report_beside_a_scene_says_its_doubts_and_a_strange_one_nothing(tmp_path: Path) -> None:
    scene = tmp_path / "s.ply"
    assert stated_warnings(scene, 3) == ()
    report = work_folder(scene) / REPORT
    report.parent.mkdir()
    report.write_text(json.dumps({"gaussians": 3, "warnings": ["dim: look\nagain", 4]}))
    assert stated_warnings(scene, 3) == ("dim: look again",)
    report.write_text(json.dumps({"gaussians": 3, "doubts": ["of an earlier version"]}))
    assert stated_warnings(scene, 3) == ("of an earlier version",)
    assert stated_warnings(scene, 4) == ()  # of another scene
    wrong = ("[]", "{", '{"gaussians": 3}', '{"gaussians": 3, "warnings": "all"}', "\udcff", "[" * 10_000)
    for text in wrong:
        report.write_bytes(text.encode("utf-8", "surrogateescape"))
        assert stated_warnings(scene, 3) == ()


# What a training is said to cost, and how much is said to be left, on a clock of the test's own.

STAGES = (
    Stage("photographs", ("reading photographs", "finding features"), 10.0),
    Stage("masks and vectors", ("masks and vectors",), 20.0),
    Stage("Gaussians", ("training Gaussians",), 60.0),
    Stage("language field", (), 10.0),
)


class Run:
    """A forecast that is told things at times."""

    def __init__(self, stages: tuple[Stage, ...] = STAGES) -> None:
        self.now, self.said = 0.0, list[Report]()
        forecast = Forecast(stages, Progress(self.said.append), self.clock)
        self.progress = Progress(forecast.show)

    def clock(self) -> float:
        return self.now

    def at(self, now: float, stage: str, fraction: float) -> tuple[float, float]:
        """Seconds left and the fraction of the whole after a report at a time."""
        self.now = now
        self.progress(stage, fraction)
        report = self.said[-1]
        assert report.stage == ALL_STAGES
        return report.metrics["seconds_left"], report.fraction


def test_a_run_as_fast_as_expected():
    run = Run()
    assert run.at(0, "reading photographs", 0.0) == (120, 0.0)
    assert run.at(5, "finding features", 0.5)[1] == pytest.approx(0.05)
    assert run.at(10, "masks and vectors", 0.0)[1] == pytest.approx(0.1)
    assert run.at(30, "training Gaussians", 0.0)[1] == pytest.approx(0.3)
    left, done = run.at(60, "training Gaussians", 0.5)
    assert (left, done) == (40, pytest.approx(0.6))
    assert run.at(90, "codebook", 0.1)[1] == pytest.approx(0.9)
    assert run.at(100, "finding things", 1.0) == (10, 1.0)


def test_what_was_slower_makes_the_rest_slower():
    run = Run()
    run.at(0, "reading photographs", 0.0)
    run.at(20, "masks and vectors", 0.0)
    assert run.at(60, "training Gaussians", 0.0)[0] == 120  # 70 s, twice


def test_kept_stages_take_nothing_and_none_goes_back():
    run = Run()
    assert run.at(0, "training Gaussians", 0.5)[1] >= 0
    assert run.at(0.001, "finding things", 0.5)[1] <= 1
    assert all(0 <= report.fraction <= 1 for report in run.said)
    run.progress("reading photographs", 1.0)
    assert run.said[-1] == Report("reading photographs", 1.0)  # nothing new of the whole


def test_costs_grow_with_what_is_asked_for():
    def cost(config: TrainConfig, photographs: int = 20) -> float:
        return sum(stage.seconds for stage in plan(config, photographs, "nothing", False))

    quick, good, full = (with_preset(TrainConfig(), preset) for preset in ("quick", "good", "full"))
    demo = replace(quick.clip, model="demo")
    assert cost(replace(quick, clip=demo)) < 300
    assert cost(quick) < cost(good) < cost(full) < cost(PAPER)
    assert cost(quick, 10) < cost(quick, 40)
    with_sam = replace(quick, masks=MaskConfig(sam="facebook/sam-vit-huge"))
    assert cost(with_sam) > cost(quick) + 20 * 300
    named = {stage.name: stage.seconds for stage in plan(full, 20, "points", True)}
    assert named["Gaussians"] == 0
    assert named["photographs"] < 5


def test_masks_cost_what_points_crops_and_weights_do(tmp_path: Path):
    def cost(sam: str, *, on_gpu: bool = False, clip: str = "demo", **settings: int) -> float:
        masks = MaskConfig(sam=sam, **settings)
        config = replace(TrainConfig(), masks=masks, clip=replace(TrainConfig().clip, model=clip))
        stages = plan(config, 1, "points", True, on_gpu)
        return {stage.name: stage.seconds for stage in stages}["masks and vectors"]

    huge, base = "facebook/sam-vit-huge", "facebook/sam-vit-base"
    few, many = (cost(base, points_per_side=side) for side in (8, 32))
    assert many > 4 * few
    assert cost(huge, points_per_side=8) > 3 * few
    assert cost(base, points_per_side=8, crop_layers=1) == pytest.approx(5 * few, rel=0.15)
    tiny, large = (cost(f"facebook/sam2.1-hiera-{size}", points_per_side=8) for size in ("tiny", "large"))
    assert tiny < large < few * 2
    assert cost(huge, on_gpu=True) < cost(huge) / 10
    assert cost(base, clip="openai/clip-vit-large-patch14") > cost(base, clip="any/other") + 100
    file = tmp_path / "mine.pth"
    with file.open("wb") as weights:
        weights.truncate(4 * 94_000_000)  # a hole: no byte is written
    assert cost(str(file), points_per_side=8) == pytest.approx(few)
    assert forecast_in_words(STAGES, on_gpu=True).startswith("about 2 min on two CPU cores and a GPU (")


def test_photographs_are_counted_where_they_lie(tmp_path: Path):
    assert count_photographs(tmp_path / "gone") == (0, "nothing")
    for name in ("a.jpg", "b.PNG", "c.txt"):
        (tmp_path / name).write_bytes(b"")
    assert count_photographs(tmp_path) == (2, "nothing")
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.jpg").write_bytes(b"")
    (tmp_path / "transforms.json").write_text("{}")
    assert count_photographs(tmp_path) == (1, "cameras")
    assert count_photographs(tmp_path / "transforms.json") == (1, "cameras")
    (tmp_path / "transforms.json").write_text('{"ply_file_path": "points.ply"}')
    assert count_photographs(tmp_path) == (1, "points")
    (tmp_path / "transforms.json").unlink()
    (tmp_path / "sparse").mkdir()
    assert count_photographs(tmp_path) == (1, "points")


def test_what_was_measured_is_foretold_within_a_third():
    """Sixteen photographs of bananas without cameras, quick: 120 s of the processor (docs/photographs.md)."""
    quick = with_preset(TrainConfig(), "quick")
    bananas = replace(quick, clip=replace(quick.clip, model="demo"))
    stages = {stage.name: stage.seconds for stage in plan(bananas, 16, "nothing", False)}
    assert sum(stages.values()) == pytest.approx(120, rel=1 / 3)
    for name, seconds in (("photographs", 75), ("Gaussians", 22)):
        assert stages[name] == pytest.approx(seconds, rel=1 / 3)
