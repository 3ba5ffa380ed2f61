"""State of a training: first Gaussians, Adam, gradients, checkpoints."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from langsplat_core.config import RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import FormatError, InputError
from langsplat_core.scene import Gaussians, look_at
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.state import (
    PARAMETERS,
    TrainingState,
    adam_step,
    clean_gradients,
    fingerprint,
    initial_gaussians,
    load_checkpoint,
    save_checkpoint,
    start,
)
from tests.support.radiance import SIZE, capture
from tests.support.scenes import random_gaussians

CPU = torch.device("cpu")


def test_initial_gaussians_lie_on_usable_points() -> None:
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
def test_few_points_are_topped_up_in_the_view_volume(known: int) -> None:
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


def test_adam_is_torch_adam() -> None:
    state = start(random_gaussians(10, sh_degree=1), 0, CPU)
    twin = state.values["means"].detach().clone().requires_grad_()
    optimiser = torch.optim.Adam([twin], lr=0.01, eps=1e-15)
    rest = state.values["sh_rest"].detach().clone()
    for step in range(5):
        for value in (state.values["means"], twin):
            value.grad = None
            ((value - 3) ** 2 * (step + 1)).sum().backward()
        adam_step(state, dict.fromkeys(PARAMETERS, 0.01))
        optimiser.step()
    torch.testing.assert_close(state.values["means"].detach(), twin.detach())
    assert state.updates["means"] == 5
    assert state.updates["sh_rest"] == 0  # no gradient: not touched
    assert torch.equal(state.values["sh_rest"].detach(), rest)


def test_non_finite_gradients_are_zeroed_and_counted() -> None:
    state = start(random_gaussians(4), 0, CPU)
    state.values["means"].grad = torch.tensor([[1.0, math.nan, 2.0]] * 2 + [[math.inf, 0.0, -math.inf]] * 2)
    state.values["log_scales"].grad = torch.full((4, 3), 3e38)  # finite, but its sum is not
    clean_gradients(state)
    assert state.non_finite == 2 + 4
    assert state.values["means"].grad.tolist() == [[1, 0, 2]] * 2 + [[0, 0, 0]] * 2
    assert float(state.values["log_scales"].grad.min()) == pytest.approx(3e38)


def filled_state() -> TrainingState:
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=shape) for shape in ((9, 3), (9, 3), (9, 4), (9,), (9, 4, 3))]
    state = start(Gaussians(*arrays), 5, CPU)
    for name in PARAMETERS:
        state.first[name] += torch.rand_like(state.first[name])
        state.second[name] += torch.rand_like(state.second[name])
    state.grad_sum += 0.25
    state.seen += 3
    state.step, state.queue, state.non_finite = 17, [2, 0], 1
    state.updates["means"] = 17
    state.rng.standard_normal(3)
    return state


def make_capture() -> Capture:
    rng = np.random.default_rng(1)
    cameras = [look_at(eye, np.zeros(3), np.array([0, 1, 0]), (8, 6)) for eye in np.eye(3) * 4 + 0.1]
    images = [rng.integers(0, 255, (6, 8, 3), dtype=np.uint8) for _ in cameras]
    return Capture(tuple(cameras), tuple(images), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_checkpoints_restore_the_exact_state(tmp_path: Path) -> None:
    state = filled_state()
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, state, "abc")
    back = load_checkpoint(path, "abc", CPU)
    for name in PARAMETERS:
        assert torch.equal(back.values[name], state.values[name])
        assert back.values[name].requires_grad
        assert torch.equal(back.first[name], state.first[name])
        assert torch.equal(back.second[name], state.second[name])
    assert torch.equal(back.grad_sum, state.grad_sum)
    assert torch.equal(back.seen, state.seen)
    assert (back.step, back.queue, back.non_finite, back.updates) == (17, [2, 0], 1, state.updates)
    assert back.rng.standard_normal(4).tolist() == state.rng.standard_normal(4).tolist()
    assert [file.name for file in tmp_path.iterdir()] == ["run.safetensors"]  # no temporary file left


def test_a_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, filled_state(), "abc")
    with pytest.raises(InputError, match="other photographs or settings; delete it") as caught:
        load_checkpoint(path, "def", CPU)
    assert not isinstance(caught.value, FormatError)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("damage", ["truncated", "text", "empty", "foreign", "missing tensor"])
def test_damaged_checkpoints_are_refused_in_one_line(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, filled_state(), "abc")
    whole = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(whole[:-20])
    elif damage == "text":
        path.write_text("not a checkpoint")
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "foreign":
        save_file({"x": torch.zeros(2)}, path)
    else:
        path.write_bytes(whole.replace(b"values.means", b"values.meanz"))
    with pytest.raises(FormatError, match="not a usable checkpoint") as caught:
        load_checkpoint(path, "abc", CPU)
    assert "\n" not in str(caught.value)


def test_fingerprint_depends_on_what_decides_the_result() -> None:
    capture, config = make_capture(), RadianceConfig()
    base = fingerprint(capture, config, [0, 1])
    assert fingerprint(make_capture(), config, [0, 1]) == base
    assert fingerprint(capture, replace(config, checkpoint_every=7, backend="cpu"), [0, 1]) == base
    assert fingerprint(capture, replace(config, seed=1), [0, 1]) != base
    assert fingerprint(capture, config, [0, 2]) != base
    brighter = [capture.images[0] + 1, *capture.images[1:]]
    assert fingerprint(replace(capture, images=tuple(brighter)), config, [0, 1]) != base
    moved = [replace(capture.cameras[0], fx=9.0), *capture.cameras[1:]]
    assert fingerprint(replace(capture, cameras=tuple(moved)), config, [0, 1]) != base
