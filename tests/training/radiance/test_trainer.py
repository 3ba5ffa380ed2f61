"""Radiance training on a tiny scene drawn by the reference rasterizer: schedule, whole runs, budgets."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import load_file

from langsplat_core.arrays import psnr
from langsplat_core.config import INRIA, RadianceConfig, TrainConfig, with_preset
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import BackendError, InputError
from langsplat_core.progress import Progress, WorkCancelledError
from langsplat_core.raster.render import render
from langsplat_core.scene import Scene, look_at
from langsplat_core.training.radiance import differentiable
from langsplat_core.training.radiance.differentiable import CpuRenderer, evaluate_views, renderer_for
from langsplat_core.training.radiance.state import PARAMETERS, initial_gaussians, start
from langsplat_core.training.radiance.stereo import STAGE as DEPTHS
from langsplat_core.training.radiance.trainer import STAGE, VISITS, schedule_for, supported, train_radiance
from tests.support.processes import files_in_use, stop_at
from tests.support.scenes import SHORT, SIZE, capture, picture, truth


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
    assert schedule.coarse_until == 0


def test_a_small_budget_moves_geometry_faster_and_cools() -> None:
    runs = (30_000, 15_000), (300, 150), (300, 300)
    full, short, last = (schedule_for(RadianceConfig(steps=n), 2.0).learning_rates(at) for n, at in runs)
    for name in ("means", "log_scales", "quats_wxyz"):
        assert short[name] == pytest.approx(10 * full[name])  # the root of 100
    for name in ("opacity_logits", "sh_dc", "sh_rest"):
        assert short[name] == full[name] == pytest.approx(20 * last[name])
    assert schedule_for(RadianceConfig(steps=60_000), 2.0).learning_rates(30_000) == full


@pytest.mark.parametrize("steps", [100, 300, 600, 1_000, 3_000, 7_000])
def test_small_budgets_leave_time_to_recover(steps: int) -> None:
    schedule = schedule_for(RadianceConfig(steps=steps), extent=1.0)
    resets = [step for step in range(1, steps + 1) if schedule.resets_opacity(step)]
    rounds = [step for step in range(1, steps + 1) if schedule.densifies(step)]
    assert all(step <= steps * 2 / 3 for step in resets + rounds)
    assert all(steps - step >= 600 for step in resets)
    assert schedule.densify_every >= 20
    assert len(rounds) >= (5 if steps >= 600 else 1)


def test_gradients_are_those_of_the_reference_picture() -> None:
    """By a random direction in all parameters; without cut-offs, whose jumps no gradient contains."""
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
        ours = float((grad.double() * (places[0] - places[1])).sum())  # rounded to float32, both ways
        assert ours == pytest.approx(ends[0] - ends[1], rel=1e-3, abs=1e-6), name


@pytest.mark.long
def test_training_learns_the_scene() -> None:
    config = RadianceConfig(steps=250, backend="cpu", sh_degree=0, max_gaussians=2_000)
    views = [0, 1, 2, 3, 4]
    first = initial_gaussians(capture(), views, 0, 2_000, 0)
    before = evaluate_views(first, capture(), [*views, 5], "cpu")
    told: list[float] = []
    progress = Progress(lambda at: told.append(at.metrics.get("psnr", 0.0)))
    trained = train_radiance(capture(), config, views, progress=progress, held_out=[5])
    after = evaluate_views(trained, capture(), [*views, 5], "cpu")
    assert told[-1] == pytest.approx(after[5].psnr, abs=0.5)
    assert len(set(told)) > 10
    assert np.mean([s.psnr for s in after[:5]]) > np.mean([s.psnr for s in before[:5]]) + 10
    assert after[5].psnr > before[5].psnr + 5  # the view that was not trained on
    assert after[5].ssim > before[5].ssim
    assert all(0 < score.covered <= 1 for score in [*before, *after])
    assert trained.valid().all()
    assert trained.opacity_logits.min() > -5.6  # none below alpha 1/255


def test_one_view_is_enough_and_none_is_refused() -> None:
    assert len(train_radiance(capture(), replace(SHORT, steps=5), [0])) > 0
    with pytest.raises(InputError, match="no photographs to train on"):
        train_radiance(capture(), SHORT, [])


def test_an_ensemble_resumes_exactly(tmp_path: Path) -> None:
    config, path, told = replace(SHORT, ensemble=2), tmp_path / "run", []
    heard = Progress(lambda at: told.append(at.fraction) if at.stage == STAGE else None)
    whole = train_radiance(capture(), config, [0, 1, 2], progress=heard)
    assert told == sorted(set(told))
    assert told[-1] == pytest.approx(1)
    assert len(whole) <= config.max_gaussians
    for fraction in (0.3, 0.6, 0.97):  # in the first member, the second one, and both together
        with pytest.raises(WorkCancelledError):
            train_radiance(capture(), config, [0, 1, 2], path, stop_at(STAGE, fraction))
    assert [file.name for file in tmp_path.iterdir()] == ["run"]  # no temporary file left
    resumed = train_radiance(capture(), config, [0, 1, 2], path)
    assert str(path) not in files_in_use()  # what is mapped cannot be written again on Windows
    for name, array in vars(whole).items():
        np.testing.assert_array_equal(array, getattr(resumed, name), err_msg=name)


@pytest.mark.parametrize("what", ["empty", "masked"])
def test_views_that_show_nothing_do_not_disturb_training(what: str) -> None:
    away = look_at(np.array([0, 0, -4.0]), np.array([0, 0, -9.0]), np.array([0.0, -1.0, 0.0]), SIZE)
    blind = replace(capture(), cameras=(away, *capture().cameras[1:]))
    masked = replace(capture(), masks=(np.zeros(SIZE[::-1], bool), *[None] * 5))
    config = replace(SHORT, steps=12, exposure="on")
    trained = train_radiance(blind if what == "empty" else masked, config, [0, 1, 2])
    assert len(trained) > 100
    assert trained.valid().all()


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_missing_cuda_is_refused() -> None:
    with pytest.raises(BackendError, match="no CUDA device; try --backend cpu"):
        train_radiance(capture(), replace(SHORT, backend="cuda"), [0])
    assert isinstance(renderer_for("auto"), CpuRenderer)


@pytest.mark.long
def test_training_finds_exposures_of_photographs() -> None:
    """Every other photograph is brighter by a third, the others darker: the scene's colours are neither's."""

    def photographs(*gains: float) -> Capture:  # a half is taken of all, so that nothing is clipped
        images = zip(gains, capture().images, strict=True)
        return replace(capture(), images=tuple(np.uint8(0.5 * gain * image) for gain, image in images))

    uneven, even = photographs(1.3, 0.7, 1.3, 0.7, 1, 1), photographs(1, 1, 1, 1, 1, 1)
    config = RadianceConfig(steps=200, backend="cpu", sh_degree=1, max_gaussians=2_000)
    views = [0, 1, 2, 3]
    off, auto = (train_radiance(uneven, replace(config, exposure=kind), views) for kind in ("off", "auto"))  # type: ignore[arg-type]
    psnrs = [np.mean([s.psnr for s in evaluate_views(one, even, views, "cpu")]) for one in (off, auto)]
    assert psnrs[1] > psnrs[0] + 2
    apart = evaluate_views(auto, uneven, [0, 1, 2], "cpu")  # in its own exposure each is further away
    assert all(score.psnr_exposed is not None and score.psnr_exposed > score.psnr + 2 for score in apart)
    off, auto = (train_radiance(even, replace(config, exposure=kind), views) for kind in ("off", "auto"))  # type: ignore[arg-type]
    np.testing.assert_array_equal(off.sh, auto.sh)  # nothing to explain


@pytest.mark.long
def test_training_ignores_transients(tmp_path: Path) -> None:
    config = RadianceConfig(steps=250, backend="cpu", sh_degree=0, max_gaussians=2_000)
    images = [image.copy() for image in capture().images]
    images[1][16:34, 18:30] = (250, 40, 250)
    passed, views = replace(capture(), images=tuple(images)), [0, 1, 2, 3, 4]
    trained = train_radiance(passed, config, views, tmp_path / "run")
    moving = load_file(tmp_path / "run")["watched.moving"].numpy()  # (V, 32, 32) patches at the end
    assert moving[1, 12:22, 13:19].mean() > 0.8  # of patches, within the 48 pixels
    assert moving[[0, 2, 3, 4]].mean() < 0.02
    off = train_radiance(passed, replace(config, transients="off"), views)
    with_it, without = (evaluate_views(one, capture(), [1], "cpu")[0].psnr for one in (off, trained))
    assert without > with_it + 3


@pytest.mark.parametrize("steps", [128, 512])
def test_runs_look_for_transients_as_often_however_long(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    looks, look = [], differentiable.rendered_depths
    monkeypatch.setattr(differentiable, "rendered_depths", lambda *given: looks.append(1) or look(*given))
    config = RadianceConfig(steps=steps, backend="cpu", sh_degree=0, max_gaussians=200, transients="on")
    train_radiance(capture(), replace(config, few_views=0), [0, 1])
    assert len(looks) == pytest.approx(64 * 2 * 0.8 + 4 * 2, abs=4)


@pytest.mark.long
@pytest.mark.parametrize("few_views", [2, 3])
def test_few_views_alone_use_depths(few_views: int) -> None:
    begun: list[tuple[str, float]] = []
    told = Progress(lambda at: begun.append((at.stage, at.fraction)))
    train_radiance(capture(), replace(SHORT, steps=2, few_views=few_views), [0, 1, 2], progress=told)
    assert ((DEPTHS, 0.0) in begun) == (few_views == 3)


# Budgets that few photographs support, and scores.


def test_presets_are_capped_with_few_views_only() -> None:
    quick, good = (with_preset(TrainConfig(), preset).radiance for preset in ("quick", "good"))
    full, uncapped = RadianceConfig(), RadianceConfig(capped_views=0)
    assert supported(quick, 9) == quick
    assert supported(good, 9) == replace(good, steps=9 * VISITS, ensemble=2)
    assert supported(replace(good, ensemble=1), 2) == replace(good, steps=quick.steps, ensemble=1)
    most = {"max_gaussians": 60_000, "sh_degree": 1, "ensemble": 2}
    assert supported(full, 9) == replace(full, steps=9 * VISITS, **most)
    assert supported(full, full.capped_views + 1) == full
    assert supported(uncapped, 9) == uncapped
    small = RadianceConfig(steps=1_500, max_gaussians=5_000, sh_degree=0)
    assert supported(small, 24) == replace(small, ensemble=2)


def test_small_scores_compare_shrunk_images() -> None:
    """As if both had been shrunk beforehand; what a mask leaves out of a small pixel leaves out the pixel."""
    scene, mask = truth(), np.ones((640, 640), bool)
    mask[:, 301:] = False
    cameras = tuple(camera.resized(640, 640) for camera in capture().cameras[:2])
    noise = np.random.default_rng(0).integers(0, 255, (2, 640, 640, 3), dtype=np.uint8)
    photographs = replace(capture(), cameras=cameras, images=tuple(noise), masks=(None, mask))
    scores = evaluate_views(scene, photographs, [0, 1], "cpu", photographs.shrunk([0, 1], 320))
    for index, (score, columns) in enumerate(zip(scores, (320, 150), strict=True)):
        drawn = render(Scene(scene), photographs.cameras[index]).colours.clip(0, 1)
        pair = np.round(255 * drawn).astype(np.uint8), photographs.images[index]
        size, how = (320, 320), Image.Resampling.LANCZOS
        small = [np.asarray(Image.fromarray(one).resize(size, how)) for one in pair]
        expected = psnr(*(one[:, :columns] / 255 for one in small))
        assert score.psnr_small == pytest.approx(expected, abs=0.01)
        assert expected > score.psnr + 1  # of noise
