"""Rehearsals: steps that few photographs support, decided by views held out of the training views."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core import config as settings
from langsplat_core.arrays import ViewScore
from langsplat_core.config import RadianceConfig, TrainConfig, with_preset
from langsplat_core.datasets.capture import Capture
from langsplat_core.progress import Cancelled, Progress, Report
from langsplat_core.scene import look_at
from langsplat_core.training.radiance import rehearsal
from langsplat_core.training.radiance.rehearsal import checkpoints_of, rehearse, supported

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
    steps = [with_preset(TrainConfig(), name).radiance.rehearsals(9) for name in ("quick", "good", "full")]
    assert steps == [[500], [500, 1500], [1111, 3333, 10000, 30000]]
    assert RadianceConfig().rehearsals(RadianceConfig.rehearsed_views + 1) == [30_000]
    assert RadianceConfig(rehearsed_views=0).rehearsals(9) == [30_000]


def test_it_ends_where_more_steps_do_not_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    trained: list[tuple[int, int, int]] = []
    scores = {1_111: 20.0, 3_333: 21.0, 10_000: 20.5, 30_000: 25.0}

    def train(small: Capture, config: RadianceConfig, indices: list[int], *_: object) -> int:
        trained.append((config.steps, len(indices), small.cameras[0].width))
        return config.steps

    def scored(steps: int, small: Capture, held_out: list[int], *_: object) -> list[ViewScore]:
        assert all(index < len(small) for index in held_out)
        return [ViewScore("", 0.0, 0.0, 1.0, scores[steps] + way) for way in (-1, 1)]

    monkeypatch.setattr(rehearsal, "train_radiance", train)
    monkeypatch.setattr(rehearsal, "evaluate_views", scored)
    config = RadianceConfig()
    found = rehearse(capture(640), config, range(VIEWS))
    assert found == {1_111: 20.0, 3_333: 21.0, 10_000: 20.5}
    assert trained == [(steps, VIEWS - 1, 320) for steps in found]
    assert supported(found, config, VIEWS) == replace(config, steps=3_333)
    assert supported({1_111: 20.0, 3_333: 20.1}, config, VIEWS).steps == 1_111  # it may be chance
    assert supported({}, config, 100) == config
    trained.clear()
    assert rehearse(capture(), config, [0, 4, 7]) == {}  # none can be spared
    assert not trained
    assert supported({}, config, 3).steps == 1_111


@pytest.mark.long
def test_an_interrupted_rehearsal_ends_as_an_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(settings, "FEWEST_REHEARSED", 12)
    reports: list[Report] = []

    def stop(at: Report) -> None:
        reports.append(at)
        if at.stage == rehearsal.STAGE and at.fraction > 0.75:
            raise Cancelled

    path = tmp_path / "rehearsal.safetensors"
    straight = rehearse(capture(), SHORT, range(VIEWS))
    assert list(straight) in ([12, 36], [12])
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
