"""Rehearsals: budgets that few photographs support, decided by views held out of the training views."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core import config as settings
from langsplat_core.arrays import ViewScore, psnr
from langsplat_core.config import GOOD, QUICK, RadianceBudget, RadianceConfig, TrainConfig, with_preset
from langsplat_core.datasets.capture import Capture
from langsplat_core.progress import Cancelled, Progress, Report
from langsplat_core.raster.render import render
from langsplat_core.scene import Gaussians, Scene, look_at
from langsplat_core.training.radiance import rehearsal
from langsplat_core.training.radiance.rehearsal import (
    budgets_for,
    checkpoints_of,
    rehearse,
    supported,
    train_within,
)
from langsplat_core.training.radiance.train import evaluate_views

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
    tried = [one.radiance.budgets(9, one.dataset.max_side) for one in (quick, good, full)]
    assert tried[0] == [QUICK]
    assert tried[1] == [QUICK, RadianceBudget(480, 500, 60_000, 1), GOOD]
    whole = RadianceBudget(800, 30_000, 1_000_000, 3)
    assert tried[2] == [*tried[1], whole._replace(steps=4_500), whole]
    assert RadianceConfig().budgets(RadianceConfig.rehearsed_views + 1, 800) == [whole]
    assert RadianceConfig(rehearsed_views=0).budgets(9, 800) == [whole]
    small = RadianceConfig(steps=1_500, max_gaussians=5_000, sh_degree=0).budgets(9, 200)
    assert small == [RadianceBudget(200, steps, 5_000, 0) for steps in (500, 1500)]


def test_it_ends_where_more_loses(monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[tuple[int, int, int]] = []
    scores = {320: 20.0, 500: 20.2, 1_500: 21.0, 4_500: 20.5, 30_000: 25.0}

    def train(small: Capture, config: RadianceConfig, indices: list[int], *_: object) -> int:
        trained.append((config.steps, len(indices), small.cameras[0].width))
        return config.steps

    def scored(steps: int, small: Capture, held_out: list[int], *_: object) -> list[ViewScore]:
        assert all(index < len(small) for index in held_out)
        found = scores[small.cameras[0].width if small.cameras[0].width == QUICK.longer_side else steps]
        return [ViewScore("", 0.0, 0.0, 1.0, found + way) for way in (-1, 1)]

    monkeypatch.setattr(rehearsal, "train_radiance", train)
    monkeypatch.setattr(rehearsal, "evaluate_views", scored)
    config, photographs = RadianceConfig(), capture(800)
    budgets = budgets_for(photographs, config, VIEWS)
    found = rehearse(photographs, config, range(VIEWS))
    assert found == [20.0, 20.2, 21.0, 20.5]
    sizes = zip((500, 500, 1_500, 4_500), (320, 480, 480, 800), strict=True)
    assert trained == [(steps, VIEWS - 1, side) for steps, side in sizes]
    assert supported(found, budgets) == budgets[2]
    assert supported([20.0, 20.1], budgets) == budgets[0]  # it may be chance
    trained.clear()
    assert rehearse(photographs, config, [0, 4, 7]) == []  # none can be spared
    assert not trained
    assert supported([], budgets) == budgets[0] == QUICK


def test_fewer_pixels_show_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_scores_compare_between_sizes() -> None:
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
    scores = evaluate_views(scene, photographs, [0, 1], "cpu")
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
    monkeypatch.setattr(settings, "QUICK", RadianceBudget(320, 12, 30_000, 1))
    reports: list[Report] = []

    def stop(at: Report) -> None:
        reports.append(at)
        if at.stage == rehearsal.STAGE and at.fraction > 0.75:
            raise Cancelled

    path = tmp_path / "rehearsal.safetensors"
    straight = rehearse(capture(), SHORT, range(VIEWS))
    assert len(straight) == 2
    with pytest.raises(Cancelled):
        rehearse(capture(), replace(SHORT, rehearsed_views=50), range(VIEWS), path, Progress(stop))
    assert len(checkpoints_of(path)) == 2
    assert {report.stage for report in reports} == {rehearsal.STAGE}
    assert reports[0].fraction < 0.1
    again: list[Report] = []
    found = rehearse(
        capture(), replace(SHORT, rehearsed_views=50), range(VIEWS), path, Progress(again.append)
    )
    assert found == straight
    assert len(again) < len(reports)
