"""Radiance training end to end on a tiny scene drawn by the reference rasterizer."""

import os
import signal
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.config import INRIA, RadianceConfig, RasterSettings
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import BackendError, InputError
from langsplat_core.progress import Cancelled, Progress, Report
from langsplat_core.raster.reference import C0, ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians, look_at
from langsplat_core.training.radiance.differentiable import CpuRenderer, renderer_for
from langsplat_core.training.radiance.state import (
    PARAMETERS,
    TrainingState,
    add_opacity_decay,
    initial_gaussians,
    start,
)
from langsplat_core.training.radiance.train import evaluate_views, train_radiance

SIZE = (48, 48)
SHORT = RadianceConfig(  # its own reference, so that nothing is rescaled: 40 steps with all that happens
    steps=40,
    reference_steps=40,
    backend="cpu",
    sh_degree=1,
    sh_degree_every=15,
    densify_from=4,
    densify_until=30,
    densify_every=10,
    opacity_reset_every=25,
    coarse_fraction=0.25,
    max_gaussians=1_300,
)


def picture(gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> Array:
    """(H, W, 3) float64 colours on black, by the reference."""
    values = colours(gaussians.sh, gaussians.means, camera.position)
    return ReferenceRasterizer().view(gaussians, camera, settings).splat(values)[0]


@cache
def truth() -> Gaussians:
    rng = np.random.default_rng(3)
    count = 40
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / C0
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)),
        np.log(rng.uniform(0.08, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        np.full(count, 2.0),
        sh,
    )


@cache
def capture() -> Capture:
    """Six views around the scene, the last for testing; points near the true means, colours unknown."""
    angles = np.linspace(0, 1.6, 6)[[0, 1, 2, 4, 5, 3]]
    eyes = [np.array([4 * np.sin(a), -0.5 - 0.3 * np.cos(5 * a), -4 * np.cos(a)]) for a in angles]
    cameras = [look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]), SIZE, 40.0) for eye in eyes]
    images = [np.round(255 * picture(truth(), c).clip(0, 1)).astype(np.uint8) for c in cameras]
    rng = np.random.default_rng(4)
    points = np.repeat(truth().means.astype(np.float64), 8, axis=0)
    points += 0.08 * rng.normal(size=points.shape)
    return Capture(tuple(cameras), tuple(images), points, np.full(points.shape, 128, np.uint8))


def as_arrays(gaussians: Gaussians) -> list[Array]:
    return [getattr(gaussians, name) for name in gaussians.__dataclass_fields__]


def test_gradients_are_those_of_the_reference_picture() -> None:
    """A random direction in every parameter, against central differences of the float64 picture.

    Without the cut-offs: a difference quotient also sees the jumps of 1/255 where pixels enter an extent,
    which no rasterizer's gradient contains. The step is short enough to swap no two depths.
    """
    smooth = replace(INRIA, alpha_min=1e-7, transmittance_min=1e-12, alpha_max=0.9999)
    rng = np.random.default_rng(0)
    base = truth()
    base = replace(base, sh=np.concatenate([base.sh, 0.1 * rng.normal(size=(40, 3, 3))], axis=1))
    camera, weight = capture().cameras[0], rng.normal(size=(48, 48, 3))
    parameters = start(base, 0, torch.device("cpu")).values
    rendered = CpuRenderer(smooth).render(parameters, camera, 1)
    np.testing.assert_allclose(rendered.image.detach().numpy(), picture(base, camera, smooth), atol=1e-5)
    assert bool(rendered.visible.all())
    (rendered.image * torch.tensor(weight, dtype=torch.float32)).sum().backward()
    for name in PARAMETERS:
        direction = 1e-4 * torch.from_numpy(rng.normal(size=parameters[name].shape).astype(np.float32))
        ends, places = [], []
        for sign in (1, -1):
            moved = start(base, 0, torch.device("cpu"))
            with torch.no_grad():
                moved.values[name] += sign * direction
            ends.append((picture(moved.gaussians(), camera, smooth) * weight).sum())
            places.append(moved.values[name].detach().double())
        grad = parameters[name].grad
        assert grad is not None
        ours = float((grad.double() * (places[0] - places[1])).sum())  # rounded to float32, both ways
        assert ours == pytest.approx(ends[0] - ends[1], rel=1e-3, abs=1e-6), name


def test_opacity_decay_is_the_gradient_of_the_mean_opacity() -> None:
    state = start(truth(), 0, torch.device("cpu"))
    logits = state.values["opacity_logits"]
    logits.data = torch.linspace(-80, 80, len(state))  # saturated at both ends
    (0.25 * torch.sigmoid(logits.double()).mean()).backward()
    assert logits.grad is not None
    want, logits.grad = logits.grad.clone(), None
    add_opacity_decay(state, 0.25)
    torch.testing.assert_close(logits.grad, want, rtol=1e-5, atol=1e-12)
    add_opacity_decay(state, 0.25)  # on top of what is there
    torch.testing.assert_close(logits.grad, 2 * want, rtol=1e-5, atol=1e-12)


def test_opacity_decay_leaves_a_scene_with_less_light_stopped() -> None:
    plain, faded = (
        train_radiance(capture(), replace(SHORT, opacity_decay=strength), [0, 1, 2])
        for strength in (0.0, 1.0)
    )
    assert sigmoid(faded.opacity_logits).mean() < sigmoid(plain.opacity_logits).mean()


@pytest.mark.long
def test_training_learns_the_scene() -> None:
    config = RadianceConfig(steps=250, backend="cpu", sh_degree=0, max_gaussians=2_000)
    views = [0, 1, 2, 3, 4]
    first = initial_gaussians(capture(), views, 0, 2_000, 0)
    before = evaluate_views(first, capture(), [*views, 5], "cpu")
    trained = train_radiance(capture(), config, views)
    after = evaluate_views(trained, capture(), [*views, 5], "cpu")
    assert np.mean([s.psnr for s in after[:5]]) > np.mean([s.psnr for s in before[:5]]) + 10
    assert after[5].psnr > before[5].psnr + 5  # the view that was not trained on
    assert after[5].ssim > before[5].ssim
    assert all(0 < score.covered <= 1 for score in [*before, *after])
    assert trained.valid().all()
    assert trained.opacity_logits.min() > -5.6  # none below alpha 1/255


@pytest.mark.long
def test_the_loss_is_said_as_the_mean_since_it_was_said_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("langsplat_core.training.radiance.train.LOSSES_SAID", 3)
    reports: list[Report] = []
    losses: list[float] = []
    train_radiance(
        capture(),
        replace(SHORT, steps=6, reference_steps=6),
        [0, 1],
        progress=Progress(reports.append),
        on_step=lambda state, loss: losses.append(loss),
    )
    first, *said = (report.metrics for report in reports)
    means = np.reshape(losses, (3, 2)).mean(1)
    assert not first
    assert [metrics["loss"] for metrics in said] == pytest.approx(means[[0, 0, 1, 1, 2]])


@pytest.mark.long
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    straight_path, path = tmp_path / "straight.safetensors", tmp_path / "resumed.safetensors"
    straight = train_radiance(capture(), SHORT, [0, 1, 2], straight_path)

    def stop_at_20(at: Report) -> None:
        if at.fraction >= 0.5:
            raise Cancelled

    with pytest.raises(Cancelled):
        train_radiance(capture(), SHORT, [0, 1, 2], path, Progress(stop_at_20))
    steps: list[int] = []
    resumed = train_radiance(
        capture(), SHORT, [0, 1, 2], path, on_step=lambda state, loss: steps.append(state.step)
    )
    assert steps == list(range(21, 41))
    for a, b in zip(as_arrays(straight), as_arrays(resumed), strict=True):
        np.testing.assert_array_equal(a, b)
    one, other = load_file(path), load_file(straight_path)  # moments and statistics too
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)
    again = train_radiance(capture(), SHORT, [0, 1, 2], path)  # finished: nothing is left to do
    np.testing.assert_array_equal(again.means, straight.means)
    with pytest.raises(InputError, match="other photographs or settings"):
        train_radiance(capture(), replace(SHORT, steps=50), [0, 1, 2], path)


def test_ctrl_c_ends_between_two_steps_with_a_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "run.safetensors"
    seen: list[int] = []

    def interrupt(state: TrainingState, loss: float) -> None:
        seen.append(state.step)
        if state.step == 7:
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train_radiance(capture(), SHORT, [0, 1, 2], path, on_step=interrupt)
    assert signal.getsignal(signal.SIGINT) is handler
    train_radiance(capture(), SHORT, [0, 1, 2], path, on_step=lambda state, loss: seen.append(state.step))
    assert seen == list(range(1, 41))


def test_one_view_and_no_view() -> None:
    trained = train_radiance(capture(), replace(SHORT, steps=5), [0])
    assert len(trained) > 0
    with pytest.raises(InputError, match="no photographs to train on"):
        train_radiance(capture(), SHORT, [])


def test_a_view_that_sees_nothing_changes_nothing_else() -> None:
    away = look_at(np.array([0, 0, -4.0]), np.array([0, 0, -9.0]), np.array([0.0, -1.0, 0.0]), SIZE)
    blind = replace(capture(), cameras=(away, *capture().cameras[1:]))
    trained = train_radiance(blind, replace(SHORT, steps=12), [0, 1])
    assert len(trained) > 100
    assert trained.valid().all()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_asking_for_cuda_where_there_is_none_is_one_line() -> None:
    with pytest.raises(BackendError, match="no CUDA device; use --backend cpu") as caught:
        train_radiance(capture(), replace(SHORT, backend="cuda"), [0])
    assert "\n" not in str(caught.value)
    assert isinstance(renderer_for("auto"), CpuRenderer)


def test_initial_gaussians_sit_on_the_points() -> None:
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.7, 0.7, 15)] * 3), -1).reshape(-1, 3)
    # not finite; a repetition; behind all cameras; far from every other point; and a good one
    bad = np.array([[np.nan, 0, 0], grid[7], [0, 0, -40.0], [0.1, 0.1, 3.0], [0.7, 0.7, 0.8]])
    points = np.concatenate([grid, bad])
    rgb = rng.integers(0, 255, points.shape, dtype=np.uint8)
    made = initial_gaussians(replace(capture(), points=points, colours=rgb), [0, 1, 2], 3, 10**6, 0)
    assert made.sh.shape == (15**3 + 1, 16, 3)
    np.testing.assert_allclose(made.means[: 15**3], grid, atol=1e-6)
    np.testing.assert_allclose(np.exp(made.log_scales[: 15**3]), 0.1, rtol=1e-5)  # the grid's spacing
    np.testing.assert_allclose(made.sh[: 15**3, 0] * C0 + 0.5, rgb[: 15**3] / 255, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-made.opacity_logits)), 0.1, rtol=1e-5)
    few = initial_gaussians(replace(capture(), points=points, colours=rgb), [0, 1, 2], 0, 500, 0)
    assert len(few) == 500


@pytest.mark.parametrize("known", [0, 30, 200])
def test_too_few_points_are_topped_up_inside_the_view_volume(known: int) -> None:
    few = replace(capture(), points=capture().points[:known], colours=capture().colours[:known])
    made = initial_gaussians(few, range(5), 0, 10**6, 0)
    assert len(made) == (3_000 if known >= 50 else 10_000)
    new = made.means[known:].astype(np.float64)
    seen = np.zeros(len(new))
    for camera in few.cameras[:5]:
        pixels, depths = camera.project(new)
        seen += (depths > 0) & (pixels > 0).all(1) & (pixels < SIZE).all(1)
    assert (seen >= 1).all()
    assert (seen >= 3).mean() > 0.5
    assert np.linalg.norm(np.median(new, axis=0)) < 1.5  # the cameras look at the origin from 4 away
