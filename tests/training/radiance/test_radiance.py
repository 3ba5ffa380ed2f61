"""Radiance training: losses, density control, schedule, checkpoints, and whole runs on a tiny scene."""

import math
import os
import signal
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from skimage.metrics import structural_similarity

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RadianceConfig, RasterSettings
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import BackendError, FormatError, InputError
from langsplat_core.progress import Cancelled, Progress, Report
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians, look_at
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.density import accumulate, add_opacity_decay, densify, reset_opacities
from langsplat_core.training.radiance.differentiable import CpuRenderer, renderer_for
from langsplat_core.training.radiance.exposure import fit_exposure, with_exposure
from langsplat_core.training.radiance.losses import (
    blur,
    radiance_loss,
    raw_moments,
    ssim,
    ssim_terms,
)
from langsplat_core.training.radiance.scores import evaluate_views
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
from langsplat_core.training.radiance.stereo import STAGE
from langsplat_core.training.radiance.trainer import (
    for_few_views,
    schedule_for,
    train_radiance,
)
from tests.support.processes import stop_at


def pictures(seed: int, shape: tuple[int, int, int] = (31, 40, 3)) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    target = rng.random(shape)
    return torch.tensor(np.clip(target + 0.2 * rng.standard_normal(shape), 0, 1)), torch.tensor(target)


def test_ssim_agrees_with_scikit_image_away_from_the_border() -> None:
    a, b = pictures(0)
    _, want = structural_similarity(
        a.numpy(),
        b.numpy(),
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        full=True,
    )
    a1, a2, b1, b2 = ssim_terms(blur(raw_moments(a, b)))
    ours = (a1 * a2 / (b1 * b2)).numpy()
    inside = np.s_[5:-5, 5:-5]  # the border differs: zeros here, reflection there
    np.testing.assert_allclose(ours[inside], want[inside], atol=1e-10)
    assert float(ssim(a, b)) == pytest.approx(ours.mean(), abs=1e-12)


def test_blur_is_its_own_adjoint_and_keeps_constants_inside() -> None:
    a, b = pictures(2)
    assert float((blur(a) * b).sum()) == pytest.approx(float((a * blur(b)).sum()), rel=1e-12)
    flat = blur(torch.ones(20, 30, 1, dtype=torch.float64))
    assert float((flat[5:-5, 5:-5] - 1).abs().max()) < 1e-12
    assert float(flat[0, 0]) < 0.5  # zeros outside


def test_the_written_out_gradient_is_the_derivative() -> None:
    a, b = pictures(3, (9, 8, 2))
    assert torch.autograd.gradcheck(lambda x: ssim(x, b), a.clone().requires_grad_(), atol=1e-9)
    assert torch.autograd.gradcheck(lambda x: radiance_loss(x, b, 0.2), a.clone().requires_grad_(), atol=1e-8)


@pytest.mark.parametrize("shape", [(31, 40, 3), (1, 1, 3), (3, 2, 1), (64, 7, 3), (5, 90, 2)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_the_compiled_loss_is_the_formula(shape: tuple[int, int, int], weight: float) -> None:
    a, b = pictures(5, shape)
    a[0, 0] = b[0, 0]  # equal pixels have no L1 gradient
    results = []
    for dtype in (torch.float32, torch.float64):
        # float64 copies of the float32 pictures, so that both see the same signs of a - b
        picture = a.float().to(dtype).requires_grad_()
        loss = radiance_loss(picture, b.float().to(dtype), weight)
        loss.backward()
        assert picture.grad is not None
        results.append((float(loss.detach()), picture.grad.double().numpy()))
    (ours, gradient), (want, want_gradient) = results
    assert ours == pytest.approx(want, abs=1e-6)
    # 1e-7: of equal pictures the gradient is a difference of equal numbers, not exactly 0 in float32
    np.testing.assert_allclose(gradient, want_gradient, atol=2e-6 * np.abs(want_gradient).max() + 1e-7)


# Density control, the optimiser's rows, and the schedule.

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


# Checkpoints: exact, atomic, refused when they do not belong to the run.

CPU = torch.device("cpu")


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


def test_round_trip_is_exact(tmp_path: Path) -> None:
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
def test_a_damaged_file_gives_one_line(tmp_path: Path, damage: str) -> None:
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


def test_the_fingerprint_knows_what_decides_the_result() -> None:
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


# Radiance training end to end on a tiny scene drawn by the reference rasterizer.

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


def steps_into(steps: list[int]) -> Progress:
    """Progress of `SHORT` that notes the number of every step."""

    def note(at: Report) -> None:
        if at.stage != STAGE:
            steps.append(round(at.fraction * SHORT.steps))

    return Progress(note)


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
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    straight_path, path = tmp_path / "straight.safetensors", tmp_path / "resumed.safetensors"
    straight = train_radiance(capture(), SHORT, [0, 1, 2], straight_path)

    with pytest.raises(Cancelled):
        train_radiance(capture(), SHORT, [0, 1, 2], path, stop_at("training", 0.5))
    steps: list[int] = []
    resumed = train_radiance(capture(), SHORT, [0, 1, 2], path, steps_into(steps))
    assert steps == list(range(21, 41))
    for a, b in zip(as_arrays(straight), as_arrays(resumed), strict=True):
        np.testing.assert_array_equal(a, b)
    one, other = load_file(path), load_file(straight_path)  # moments and statistics too
    assert one.keys() == other.keys()
    for name in one:
        torch.testing.assert_close(one[name], other[name], rtol=0, atol=0, equal_nan=True)
    again = train_radiance(capture(), SHORT, [0, 1, 2], path)  # finished: nothing is left to do
    np.testing.assert_array_equal(again.means, straight.means)
    with pytest.raises(InputError, match="other photographs or settings"):
        train_radiance(capture(), replace(SHORT, steps=50), [0, 1, 2], path)


def test_ctrl_c_ends_between_two_steps_with_a_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "run.safetensors"
    seen: list[int] = []

    def interrupt(at: Report) -> None:
        steps_into(seen).show(at)
        if seen and seen[-1] == 7:
            os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train_radiance(capture(), SHORT, [0, 1, 2], path, Progress(interrupt))
    assert signal.getsignal(signal.SIGINT) is handler
    train_radiance(capture(), SHORT, [0, 1, 2], path, steps_into(seen))
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


# Exposures of photographs.


def test_an_exposure_is_found_and_held_at_none_by_a_ridge() -> None:
    rng = np.random.default_rng(4)
    image = torch.tensor(rng.random((30, 40, 3)), dtype=torch.float32)
    change = torch.tensor([[1.2, 0.0, 0.1], [0.0, 0.8, 0.0], [0.0, 0.1, 1.0], [0.05, -0.02, 0.0]])
    target = with_exposure(image, change)
    found = fit_exposure([(image[:10], target[:10]), (image[10:], target[10:])], ridge=0.0)
    torch.testing.assert_close(found, change, rtol=1e-4, atol=1e-5)
    x = np.pad(image.reshape(-1, 3).numpy().astype(np.float64), ((0, 0), (0, 1)), constant_values=1.0)
    y, none = target.reshape(-1, 3).numpy().astype(np.float64), np.eye(4, 3)
    hold = 0.5 * (x[:, :3] ** 2).mean() * np.eye(4)
    held = none + np.linalg.solve(x.T @ x / len(x) + hold, x.T @ (y - x @ none) / len(x))
    np.testing.assert_allclose(fit_exposure([(image, target)], ridge=0.5), held, atol=1e-5)
    nothing = torch.zeros((0, 3))
    torch.testing.assert_close(fit_exposure([(nothing, nothing)]), torch.eye(4, 3))


@pytest.mark.long
def test_photographs_of_other_exposures_teach_the_colours_between_them() -> None:
    """Every other photograph is brighter by a third, the others darker: the scene's colours are neither's."""
    gains = [1.3, 0.7, 1.3, 0.7, 1.0, 1.0]  # a half is taken of all, so that nothing is clipped
    images = [
        (0.5 * gain * image.astype(np.float64)).clip(0, 255).astype(np.uint8)
        for image, gain in zip(capture().images, gains, strict=True)
    ]
    uneven = replace(capture(), images=tuple(images))
    even = replace(capture(), images=tuple((0.5 * image).astype(np.uint8) for image in capture().images))
    config = RadianceConfig(steps=200, backend="cpu", sh_degree=1, max_gaussians=2_000)
    scores = {}
    for exposure in ("off", "auto", "on"):
        trained = train_radiance(uneven, replace(config, exposure=exposure), [0, 1, 2, 3])  # type: ignore[arg-type]
        scores[exposure] = evaluate_views(trained, even, [0, 1, 2, 3], "cpu")
    means = {exposure: np.mean([score.psnr for score in found]) for exposure, found in scores.items()}
    assert means["on"] > means["off"] + 2
    apart = evaluate_views(trained, uneven, [0, 1, 2], "cpu")  # in its own exposure each is further away
    assert all(score.psnr_exposed is not None and score.psnr_exposed > score.psnr + 2 for score in apart)
    assert means["auto"] == means["on"]
    same = {
        exposure: train_radiance(even, replace(config, exposure=exposure), [0, 1, 2, 3])  # type: ignore[arg-type]
        for exposure in ("off", "auto")
    }
    np.testing.assert_array_equal(same["off"].sh, same["auto"].sh)  # nothing to explain


def watched(config: RadianceConfig, photographs: Capture, path: Path) -> tuple[Gaussians, Array]:
    """What a training makes, and the (V, 32, 32) patches that move at its end."""
    trained = train_radiance(photographs, config, [0, 1, 2, 3, 4], path)
    return trained, load_file(path)["watched.moving"].numpy()


@pytest.mark.long
def test_what_stands_in_one_photograph_alone_does_not_count(tmp_path: Path) -> None:
    config = RadianceConfig(steps=250, backend="cpu", sh_degree=0, max_gaussians=2_000)
    images = [image.copy() for image in capture().images]
    images[1][16:34, 18:30] = (250, 40, 250)
    passed = replace(capture(), images=tuple(images))
    trained, moving = watched(config, passed, tmp_path / "auto")
    square = np.s_[12:22, 13:19]  # of patches, within the 48 pixels
    assert moving[1][square].mean() > 0.8
    assert moving[[0, 2, 3, 4]].mean() < 0.02
    off, _ = watched(replace(config, transients="off"), passed, tmp_path / "off")
    with_it, without = (evaluate_views(one, capture(), [1], "cpu")[0].psnr for one in (off, trained))
    assert without > with_it + 3
    still = [
        watched(replace(config, transients=kind), capture(), tmp_path / f"still-{kind}")[0]  # type: ignore[arg-type]
        for kind in ("auto", "off")
    ]
    np.testing.assert_array_equal(still[0].means, still[1].means)  # nothing is masked


@pytest.mark.long
def test_few_views_have_no_resets_and_many_have() -> None:
    few, many = for_few_views(SHORT), SHORT
    assert schedule_for(many, 1.0).resets_opacity(25)
    schedule = schedule_for(few, 1.0)
    assert not any(schedule.resets_opacity(step) or schedule.prunes_large(step) for step in range(1, 41))
    assert few.opacity_decay > 0
    stages: list[str] = []
    told = Progress(lambda at: stages.append(at.stage))
    train_radiance(capture(), replace(SHORT, steps=2), [0, 1, 2], progress=told)
    assert STAGE in stages
    stages.clear()
    train_radiance(capture(), replace(SHORT, steps=2, few_views=2), [0, 1, 2], progress=told)
    assert STAGE not in stages
