"""State of a training: first Gaussians, Adam, gradients, density control, checkpoints."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from langsplat_core.arrays import sigmoid
from langsplat_core.config import RadianceConfig
from langsplat_core.errors import FormatError, InputError
from langsplat_core.scene import Gaussians
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.state import (
    PARAMETERS,
    TrainingState,
    accumulate,
    adam_step,
    add_opacity_decay,
    densify,
    fingerprint,
    initial_gaussians,
    load_checkpoint,
    members,
    merged,
    reset_opacities,
    save_checkpoint,
    start,
)
from tests.support.scenes import SIZE, capture, random_gaussians, truth

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


def test_non_finite_gradients_are_zeroed() -> None:
    state = start(random_gaussians(4), 0, CPU)
    state.values["means"].grad = torch.tensor([[1.0, math.nan, 2.0]] * 2 + [[math.inf, 0.0, -math.inf]] * 2)
    state.values["log_scales"].grad = torch.full((4, 3), 3e38)  # finite, but its sum is not
    adam_step(state, dict.fromkeys(state.values, 0.01))
    means, scales = (10 * state.first[name] for name in ("means", "log_scales"))  # the gradients it took
    torch.testing.assert_close(means, torch.tensor([[1.0, 0, 2]] * 2 + [[0.0] * 3] * 2))
    assert float(scales.min()) == pytest.approx(3e38)


# Density control: rows of the optimiser follow their Gaussians through splits, clones and removals.

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
        rows = torch.arange(1.0, count + 1).reshape(-1, *[1] * (state.values[name].ndim - 1))
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
    grown = len(range(0, 200, 3)) - 1  # row 6 is one of the faint ones
    densify(state, CONFIG, EXTENT, prune_large=False)
    assert len(state) == 200 - 3 + grown  # a clone beside its Gaussian, or two children in its place
    old = state.first["means"][:, 0] > 0
    assert 200 - 3 - grown < int(old.sum()) < 200 - 3
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
    densify(state, CONFIG, EXTENT, prune_large=False)
    assert len(state) == 71
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
    want, logits.grad = logits.grad.clone(), None
    add_opacity_decay(state, 0.25)
    torch.testing.assert_close(logits.grad, want, rtol=1e-5, atol=1e-12)
    add_opacity_decay(state, 0.25)  # on top of what is there
    torch.testing.assert_close(logits.grad, 2 * want, rtol=1e-5, atol=1e-12)


# Ensembles and checkpoints.


def test_members_merge_with_a_share_of_their_opacity() -> None:
    states = [make_state(9, seed) for seed in range(3)]
    for before, state in pairwise(states):
        state.finished, state.member = members(before), before.member + 1
    scenes, all_of_them = [state.gaussians() for state in states], merged(states[-1])
    for name, array in vars(all_of_them).items():
        want = np.concatenate([getattr(scene, name) for scene in scenes])
        if name == "opacity_logits":
            array, want = sigmoid(array.astype(np.float64)), sigmoid(want.astype(np.float64)) / 3
        np.testing.assert_allclose(array, want, rtol=1e-6, err_msg=name)


def test_a_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, make_state(9), "abc")
    with pytest.raises(InputError, match="other photographs or settings; delete it") as caught:
        load_checkpoint(path, "def", CPU)
    assert not isinstance(caught.value, FormatError)


@pytest.mark.parametrize("damage", ["truncated", "foreign", "missing tensor"])
def test_damaged_checkpoints_are_refused(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, make_state(9), "abc")
    whole = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(whole[:-20])
    elif damage == "foreign":
        save_file({"x": torch.zeros(2)}, path)
    else:
        path.write_bytes(whole.replace(b"values.means", b"values.meanz"))
    with pytest.raises(FormatError, match="not a usable checkpoint"):
        load_checkpoint(path, "abc", CPU)


def test_fingerprint_depends_on_what_decides_the_result() -> None:
    photographs, config = capture(), RadianceConfig()
    base = fingerprint(photographs, config, [0, 1])
    assert fingerprint(photographs, replace(config, checkpoint_every=7, backend="cpu"), [0, 1]) == base
    assert fingerprint(photographs, replace(config, seed=1), [0, 1]) != base
    assert fingerprint(photographs, config, [0, 2]) != base
    images = photographs.images[0] + 1, *photographs.images[1:]
    cameras = replace(photographs.cameras[0], fx=9.0), *photographs.cameras[1:]
    for changed in (replace(photographs, images=images), replace(photographs, cameras=cameras)):
        assert fingerprint(changed, config, [0, 1]) != base
