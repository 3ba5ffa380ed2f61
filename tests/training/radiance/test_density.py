"""Density control: rows of the optimiser follow their Gaussians through splits, clones and removals."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from langsplat_core.config import RadianceConfig
from langsplat_core.scene import Gaussians
from langsplat_core.training.radiance.density import accumulate, add_opacity_decay, densify, reset_opacities
from langsplat_core.training.radiance.state import (
    PARAMETERS,
    TrainingState,
    start,
)
from tests.support.radiance import truth

CONFIG = RadianceConfig(densify_grad=1.0)
EXTENT = 1.0  # so that Gaussians above 0.01 split and smaller ones are cloned


def make_state(count: int = 200, seed: int = 0) -> TrainingState:
    """Gaussians whose moments tell which row they belong to: first = row + 1, second = twice that."""
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        rng.normal(size=(count, 3)),
        np.log(rng.uniform(0.002, 0.015, (count, 3))),
        rng.normal(size=(count, 4)),
        rng.normal(1.0, 0.5, count),
        rng.normal(size=(count, 4, 3)),
    )
    state = start(gaussians, seed, torch.device("cpu"))
    for name in PARAMETERS:
        rows = torch.arange(1, count + 1, dtype=torch.float32).reshape(
            -1, *[1] * (state.values[name].ndim - 1)
        )
        state.first[name] += rows
        state.second[name] += 2 * rows
    return state


def grow(state: TrainingState, rows: list[int]) -> None:
    """Give `rows` a gradient above the threshold."""
    state.grad_sum[rows] = 10.0
    state.seen += 2.0


def test_optimiser_rows_follow_their_gaussians() -> None:
    state = make_state()
    before = {name: value.detach().clone() for name, value in state.values.items()}
    with torch.no_grad():
        state.values["opacity_logits"][[5, 6, 7]] = -8.0  # fainter than 0.005
    grow(state, list(range(0, 200, 3)))
    report = densify(state, CONFIG, EXTENT, prune_large=False)
    assert report.pruned == 3
    assert report.cloned > 0
    assert report.split > 0
    assert len(state) == 200 - 3 + report.cloned + report.split
    old = state.first["means"][:, 0] > 0
    assert int(old.sum()) == 200 - 3 - report.split
    for name in PARAMETERS:
        assert state.first[name].shape == state.second[name].shape == state.values[name].shape
        assert state.values[name].requires_grad
        origin = state.first[name].reshape(len(state), -1)[:, 0].long()[old] - 1
        torch.testing.assert_close(state.values[name].detach()[old], before[name][origin])
        torch.testing.assert_close(state.second[name], 2 * state.first[name])
        assert float(state.first[name][~old].abs().sum()) == 0  # new Gaussians begin without moments
    assert float(state.grad_sum.abs().sum() + state.seen.abs().sum()) == 0
    assert len(state.grad_sum) == len(state.seen) == len(state)


def test_children_of_a_split_lie_in_the_parent_and_are_smaller() -> None:
    state = make_state(70)
    with torch.no_grad():
        state.values["log_scales"][4] = torch.log(torch.tensor([0.5, 1e-4, 1e-4]))
        state.values["quats_wxyz"][4] = torch.tensor([1.0, 0.0, 0.0, 1.0])  # 90 degrees about z: x to y
    parent = {name: value.detach()[4].clone() for name, value in state.values.items()}
    grow(state, [4])
    report = densify(state, CONFIG, EXTENT, prune_large=False)
    assert (report.cloned, report.split, len(state)) == (0, 1, 71)
    children = {name: value.detach()[-2:] for name, value in state.values.items()}
    torch.testing.assert_close(children["log_scales"], (parent["log_scales"] - math.log(1.6)).expand(2, 3))
    offsets = children["means"] - parent["means"]
    assert float(offsets[:, [0, 2]].abs().max()) < 1e-3  # along y only: the rotated long axis
    assert 1e-3 < float(offsets[:, 1].abs().max()) < 2.5
    for name in ("quats_wxyz", "opacity_logits", "sh_dc", "sh_rest"):
        torch.testing.assert_close(children[name], torch.stack([parent[name]] * 2))


def test_cap_prefers_the_largest_gradients() -> None:
    state = make_state()
    state.grad_sum[:] = torch.linspace(10, 20, 200)
    state.seen += 1
    want = state.values["sh_dc"].detach()[-5:]
    densify(state, replace(CONFIG, max_gaussians=205, percent_dense=1e9), EXTENT, prune_large=False)
    assert len(state) == 205
    added = state.values["sh_dc"].detach()[-5:]
    torch.testing.assert_close(added.sort(0).values, want.sort(0).values)
    state.grad_sum[:] = 50.0
    state.seen += 1
    densify(state, replace(CONFIG, max_gaussians=205), EXTENT, prune_large=False)
    assert len(state) == 205


def test_large_gaussians_are_pruned_on_request() -> None:
    state = make_state()
    with torch.no_grad():
        state.values["log_scales"][[3, 9]] = math.log(0.2)
    grow(state, [9])
    densify(state, CONFIG, EXTENT, prune_large=True)
    assert len(state) == 198  # 3 is too large, so are 9's two children (0.125)
    assert float(state.values["log_scales"].detach().amax().exp()) <= 0.1


def test_pruning_keeps_the_most_opaque_gaussians() -> None:
    state = make_state()
    with torch.no_grad():
        state.values["opacity_logits"][:] = torch.linspace(-12, -8, 200)
    densify(state, CONFIG, EXTENT, prune_large=False)
    assert len(state) == 64
    assert float(state.values["opacity_logits"].detach().min()) > -9.3  # the most opaque ones


def test_opacity_reset_caps_opacities_and_clears_moments() -> None:
    state = make_state()
    with torch.no_grad():
        state.values["opacity_logits"][0] = -7.0
    reset_opacities(state)
    opacities = torch.sigmoid(state.values["opacity_logits"].detach())
    assert float(opacities[1:].max()) == pytest.approx(0.01, rel=1e-5)
    assert float(opacities[0]) == pytest.approx(1 / (1 + math.exp(7)), rel=1e-5)
    assert float(state.first["opacity_logits"].abs().sum() + state.second["opacity_logits"].sum()) == 0
    assert float(state.first["means"].sum()) > 0  # the others keep theirs
    assert state.values["opacity_logits"].requires_grad


def test_the_statistic_is_a_mean_over_visible_steps_in_ndc() -> None:
    state = make_state(3)
    gradient = torch.tensor([[3e-3, 0.0], [0.0, 1e-3], [1.0, math.nan]])
    accumulate(state, gradient, torch.tensor([True, True, False]), (200, 80))
    accumulate(state, 2 * gradient, torch.tensor([True, False, False]), (200, 80))
    assert state.seen.tolist() == [2, 1, 0]
    torch.testing.assert_close(state.grad_sum, torch.tensor([0.3 + 0.6, 0.04, 0.0]))


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
