"""Rehearsals: budgets that few photographs support, decided by views held out of the training views."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import ViewScore, psnr
from langsplat_core.config import GOOD, QUICK, RadianceBudget, RadianceConfig, TrainConfig, with_preset
from langsplat_core.datasets.capture import Capture
from langsplat_core.progress import Progress, Report, WorkCancelledError
from langsplat_core.raster.render import render
from langsplat_core.scene import Gaussians, Scene, look_at
from langsplat_core.training.radiance import rehearsal
from langsplat_core.training.radiance.rehearsal import (
    ascending_budgets,
    budgets_for,
    checkpoints_of,
    rehearse,
    supported,
    train_within,
)
from langsplat_core.training.radiance.scores import evaluate_views

VIEWS = 8
SHORT = RadianceConfig(steps=36, reference_steps=36, backend="cpu", sh_degree=0, max_gaussians=200)


def capture(side: int = 24) -> Capture:
    """Cameras on an arc; their images are noise, which nothing but learning by heart explains."""
    rng = np.random.default_rng(0)
    eyes = [np.array([4 * np.sin(a), 0.5, -4 * np.cos(a)]) for a in np.linspace(0, 1, VIEWS)]
    cameras = [look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]), (side, side), 40.0) for eye in eyes]
    images = [rng.integers(0, 255, (side, side, 3), dtype=np.uint8) for _ in eyes]
    points = rng.normal(size=(100, 3)) * 0.3
    return Capture(tuple(cameras), tuple(images), points, np.full(points.shape, 128, np.uint8))


def test_presets_are_rehearsed_with_few_views_only() -> None:
    quick, good, full = (with_preset(TrainConfig(), name) for name in ("quick", "good", "full"))
    tried = [ascending_budgets(one.radiance, 9, one.dataset.max_side) for one in (quick, good, full)]
    assert tried[0] == [QUICK]
    assert tried[1] == [QUICK, RadianceBudget(480, 500, 60_000, 1), GOOD]
    whole = RadianceBudget(800, 30_000, 1_000_000, 3)
    assert tried[2] == [*tried[1], whole._replace(steps=4_500), whole]
    assert ascending_budgets(RadianceConfig(), RadianceConfig.rehearsed_views + 1, 800) == [whole]
    assert ascending_budgets(RadianceConfig(rehearsed_views=0), 9, 800) == [whole]
    small = ascending_budgets(RadianceConfig(steps=1_500, max_gaussians=5_000, sh_degree=0), 9, 200)
    assert small == [RadianceBudget(200, steps, 5_000, 0) for steps in (500, 1500)]


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """Set what the rehearsals find, budget by budget as (steps, longer side), and return what was tried."""

    def pretend(scores: dict[tuple[int, int], list[float]]) -> list[str]:
        tried: list[str] = []
        left_out: list[int] = []

        def train(small: Capture, config: RadianceConfig, indices: list[int], *_: object) -> int:
            (missing,) = set(range(VIEWS)) - set(indices)
            if missing not in left_out:
                left_out.append(missing)
            tried.append(f"{config.steps} at {small.cameras[0].width} without {left_out.index(missing)}")
            return config.steps

        def scored(steps: int, small: Capture, held_out: list[int], *_: object) -> list[ViewScore]:
            found = scores[steps, small.cameras[0].width][left_out.index(held_out[0])]
            return [ViewScore("", 0.0, 0.0, 1.0, found)]

        monkeypatch.setattr(rehearsal, "train_radiance", train)
        monkeypatch.setattr(rehearsal, "evaluate_views", scored)
        return tried

    return pretend


def test_rehearsals_stop_at_a_losing_budget(pretended: Callable[..., list[str]]) -> None:
    photographs, config = capture(800), RadianceConfig()
    budgets = budgets_for(photographs, config, VIEWS)
    scores = {
        (500, 320): [20.0, 18.0, 15.0],
        (500, 480): [20.2, 18.2, 15.2],  # more each time, but it may be chance
        (1_500, 480): [21.0, 18.1, 15.4],
        (4_500, 800): [20.5],
    }
    tried = pretended(scores)
    found = rehearse(photographs, config, range(VIEWS))
    assert found == list(scores.values())
    small, *larger = (f"{steps} at {side} without" for steps, side in scores)
    first = [f"{name} {number}" for number in range(3) for name in (small, larger[0])]
    assert tried == [*first, *(f"{larger[1]} {number}" for number in range(3)), f"{larger[2]} 0"]
    assert supported(found, budgets) == budgets[2]


def test_one_losing_view_rejects_a_budget(pretended: Callable[..., list[str]]) -> None:
    photographs, config = capture(480), RadianceConfig(steps=1_500, max_gaussians=60_000, sh_degree=1)
    scores = {(500, 320): [20.0, 18.0], (500, 480): [19.9], (1_500, 480): [22.0, 17.9]}
    pretended(scores)
    found = rehearse(photographs, config, range(VIEWS))
    assert found == list(scores.values())
    assert supported(found, budgets_for(photographs, config, VIEWS)) == QUICK


def test_smallest_budget_is_taken_without_spare_views(pretended: Callable[..., list[str]]) -> None:
    tried = pretended({})
    budgets = budgets_for(capture(), RadianceConfig(), 3)
    assert rehearse(capture(), RadianceConfig(), [0, 4, 7]) == []
    assert not tried
    assert supported([], budgets) == budgets[0]


def test_widened_gaussians_look_the_same_at_full_size(monkeypatch: pytest.MonkeyPatch) -> None:
    photographs, sizes = capture(160), []
    rng = np.random.default_rng(1)
    fitted = Gaussians(
        means=rng.normal(0, 0.4, (60, 3)),
        log_scales=rng.normal(-5.5, 0.5, (60, 3)),
        quats_wxyz=rng.normal(size=(60, 4)),
        opacity_logits=np.full(60, 2.0),
        sh=rng.normal(0, 0.5, (60, 1, 3)),
    )

    def train(small: Capture, config: RadianceConfig, indices: list[int], *_: object) -> Gaussians:
        sizes.append((small.cameras[0].width, len(small), config.steps, list(indices)))
        return fitted

    monkeypatch.setattr(rehearsal, "train_radiance", train)
    budget = RadianceBudget(160, 7, 60, 0)
    assert train_within(photographs, budget, RadianceConfig(), [1, 2]) is fitted
    wide = train_within(photographs, budget._replace(longer_side=40), RadianceConfig(), [1, 2])
    assert sizes == [(160, VIEWS, 7, [1, 2]), (40, VIEWS, 7, [1, 2])]
    camera = photographs.cameras[1]
    small = render(Scene(fitted), camera.resized(40, 40)).colours.repeat(4, 0).repeat(4, 1)
    thin, seen = (render(Scene(gaussians), camera).colours for gaussians in (fitted, wide))
    assert np.abs(small - seen).mean() < 0.5 * np.abs(small - thin).mean()
    # A Gaussian in the middle, seen by both cameras: its variance grows by what the dilation lost.
    depth = min(photographs.cameras[i].project(fitted.means)[1][0] for i in (1, 2))
    focal = photographs.cameras[1].fx
    grown = np.exp(2 * fitted.log_scales[0].astype(float)) + 0.3 * depth**2 * (16 - 1) / focal**2
    np.testing.assert_allclose(np.exp(2 * wide.log_scales[0].astype(float)), grown, rtol=1e-4)


def test_small_scores_compare_shrunk_images() -> None:
    """As if both had been shrunk beforehand; what a mask leaves out of a small pixel leaves out the pixel."""
    rng = np.random.default_rng(2)
    photographs = capture(640)
    scene = Gaussians(
        means=rng.normal(0, 0.4, (60, 3)),
        log_scales=np.full((60, 3), -2.0),
        quats_wxyz=rng.normal(size=(60, 4)),
        opacity_logits=np.full(60, 2.0),
        sh=rng.normal(0, 0.5, (60, 1, 3)),
    )
    mask = np.ones((640, 640), bool)
    mask[:, 301:] = False
    photographs = replace(photographs, masks=(None, mask, *[None] * 6))
    scores = evaluate_views(scene, photographs, [0, 1], "cpu", photographs.shrunk([0, 1], 320))
    for index, (score, columns) in enumerate(zip(scores, (320, 150), strict=True)):
        drawn = render(Scene(scene), photographs.cameras[index]).colours.clip(0, 1)
        pair = np.round(255 * drawn).astype(np.uint8), photographs.images[index]
        small = [
            np.asarray(Image.fromarray(one).resize((320, 320), Image.Resampling.LANCZOS)) for one in pair
        ]
        expected = psnr(*(one[:, :columns] / 255 for one in small))
        assert score.psnr_small == pytest.approx(expected, abs=0.01)
        assert expected > score.psnr + 1  # of noise


@pytest.mark.long
def test_an_interrupted_rehearsal_ends_as_an_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rehearsal, "QUICK", RadianceBudget(320, 12, 30_000, 1))
    reports: list[Report] = []

    def stop(at: Report) -> None:
        reports.append(at)
        if at.stage == rehearsal.STAGE and at.fraction > 0.25:
            raise WorkCancelledError

    path = tmp_path / "rehearsal.safetensors"
    straight = rehearse(capture(), SHORT, range(VIEWS))
    assert len(straight) == 2
    assert 1 <= len(straight[0]) == len(straight[1]) <= 3
    with pytest.raises(WorkCancelledError):
        rehearse(capture(), replace(SHORT, rehearsed_views=50), range(VIEWS), path, Progress(stop))
    assert len(checkpoints_of(path)) > 1
    assert {report.stage for report in reports} == {rehearsal.STAGE}
    assert reports[0].fraction < 0.1
    again: list[Report] = []
    found = rehearse(
        capture(), replace(SHORT, rehearsed_views=50), range(VIEWS), path, Progress(again.append)
    )
    assert found == straight
    assert again[0].fraction >= 0.25
