"""Density control, the optimiser's rows, and the schedule."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from langsplat_core.config import RadianceConfig
from langsplat_core.scene import Gaussians
from langsplat_core.training.radiance.state import (
    PARAMETERS,
    TrainingState,
    accumulate,
    adam_step,
    clean_gradients,
    densify,
    reset_opacities,
    start,
)
from langsplat_core.training.radiance.train import schedule_for

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


def test_the_cap_lets_the_largest_gradients_through() -> None:
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


def test_large_gaussians_go_when_told() -> None:
    state = make_state()
    with torch.no_grad():
        state.values["log_scales"][[3, 9]] = math.log(0.2)
    grow(state, [9])
    densify(state, CONFIG, EXTENT, prune_large=True)
    assert len(state) == 198  # 3 is too large, so are 9's two children (0.125)
    assert float(state.values["log_scales"].detach().amax().exp()) <= 0.1


def test_pruning_never_leaves_nothing() -> None:
    state = make_state()
    with torch.no_grad():
        state.values["opacity_logits"][:] = torch.linspace(-12, -8, 200)
    densify(state, CONFIG, EXTENT, prune_large=False)
    assert len(state) == 64
    assert float(state.values["opacity_logits"].detach().min()) > -9.3  # the most opaque ones


def test_opacity_reset() -> None:
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


def test_adam_is_torch_adam() -> None:
    state = make_state(10)
    for moments in (state.first, state.second):
        for tensor in moments.values():
            tensor.zero_()
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
    state = make_state(4)
    state.values["means"].grad = torch.tensor([[1.0, math.nan, 2.0]] * 2 + [[math.inf, 0.0, -math.inf]] * 2)
    state.values["log_scales"].grad = torch.full((4, 3), 3e38)  # finite, but its sum is not
    clean_gradients(state)
    assert state.non_finite == 2 + 4
    assert state.values["means"].grad.tolist() == [[1, 0, 2]] * 2 + [[0, 0, 0]] * 2
    assert float(state.values["log_scales"].grad.min()) == pytest.approx(3e38)


def test_the_full_budget_is_the_inria_schedule() -> None:
    schedule = schedule_for(RadianceConfig(coarse_fraction=0), extent=5.0)
    rounds = [step for step in range(1, 30_001) if schedule.densifies(step)]
    assert rounds == list(range(600, 15_000, 100))
    resets = [step for step in range(1, 30_001) if schedule.resets_opacity(step)]
    assert resets == [3_000, 6_000, 9_000, 12_000]
    degrees = [schedule.active_sh_degree(step) for step in (1, 999, 1_000, 2_999, 3_000, 9_000)]
    assert degrees == [0, 0, 1, 2, 3, 3]
    for step in (1, 7_000, 15_000, 30_000):
        t = step / 30_000
        want = 5.0 * math.exp(math.log(1.6e-4) * (1 - t) + math.log(1.6e-6) * t)
        rates = schedule.learning_rates(step)
        assert rates.pop("means") == pytest.approx(want, rel=1e-12)
        assert rates == {
            "log_scales": 5e-3,
            "quats_wxyz": 1e-3,
            "opacity_logits": 0.05,
            "sh_dc": 2.5e-3,
            "sh_rest": 2.5e-3 / 20,
        }
    assert not schedule.prunes_large(3_000)
    assert schedule.prunes_large(3_100)
    assert schedule.coarse_until == 0


def test_a_small_budget_moves_geometry_faster() -> None:
    full, short = (schedule_for(RadianceConfig(steps=n), 2.0).learning_rates(n) for n in (30_000, 300))
    for name in ("means", "log_scales", "quats_wxyz"):
        assert short[name] == pytest.approx(10 * full[name])  # the root of 100
    for name in ("opacity_logits", "sh_dc", "sh_rest"):
        assert short[name] == full[name]
    longer = schedule_for(RadianceConfig(steps=60_000), 2.0).learning_rates(60_000)
    assert longer == full


@pytest.mark.parametrize("steps", [100, 300, 600, 1_000, 3_000, 7_000])
def test_small_budgets_leave_time_to_recover(steps: int) -> None:
    schedule = schedule_for(RadianceConfig(steps=steps), extent=1.0)
    resets = [step for step in range(1, steps + 1) if schedule.resets_opacity(step)]
    rounds = [step for step in range(1, steps + 1) if schedule.densifies(step)]
    assert all(step <= steps * 2 / 3 for step in resets + rounds)
    assert all(steps - step >= 600 for step in resets)
    assert schedule.densify_every >= 20
    assert len(rounds) >= (5 if steps >= 600 else 1)
