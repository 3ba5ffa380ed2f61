"""The rasterizer benchmark: its reference windows, baseline, fits and files. No test looks at a time."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from langsplat_core.bench import RasterBenchConfig
from langsplat_core.bench import raster as bench_report
from langsplat_core.bench.measure import Measurement, default_camera, random_scene, reference_windows
from langsplat_core.bench.memory import peak_memory, resident_memory, restart_peak
from langsplat_core.bench.raster import plot, run_plan, sweep
from langsplat_core.bench.torch_rasterizer import TorchRasterizer
from langsplat_core.cli.bench import write_report
from langsplat_core.config import INRIA
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from tests.support.comparing import BAND, assert_close_off_cuts, assert_gradient
from tests.support.scenes import random_camera, random_gaussians, random_values

pytestmark = pytest.mark.long


@pytest.fixture(autouse=True)
def one_torch_thread():
    """Scenes here are tiny, and PyTorch's threads spin while they wait for one another."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def measurement(
    gaussians=100, milliseconds=1.0, operation="splat", backend="cpu", size=(320, 240), channels=3
):
    return Measurement("random", gaussians, *size, channels, operation, backend, milliseconds)


class TestBaseline:
    """Scenes with an off-centre principal point and Gaussians beyond the Jacobian's clamp."""

    @pytest.mark.parametrize("antialiased", [False, True])
    def test_float64_is_the_reference(self, antialiased):
        settings = replace(INRIA, antialiased=antialiased)
        g, camera, x = random_gaussians(300, 1), random_camera(2, distance=1.2), random_values(300, 4)
        image, alpha = TorchRasterizer(torch.float64).view(g, camera, settings).splat(x)
        want, want_alpha = ReferenceRasterizer().view(g, camera, settings).splat(x)
        # The same numbers in another order of operations: rounding alone, on values up to 1.
        assert np.abs(image - want).max() < 1e-12
        assert np.abs(alpha - want_alpha).max() < 1e-12

    def test_float32_is_the_reference_away_from_cut_offs(self):
        g, camera, x = random_gaussians(300, 1), random_camera(2), random_values(300, 3)
        reference = ReferenceRasterizer().view(g, camera)
        image, _ = TorchRasterizer().view(g, camera).splat(x)
        assert_close_off_cuts(image, reference.splat(x)[0], reference.cut_off_band(BAND))

    def test_opaque_tiles_stop_and_the_rest_go_on(self):
        """Many tiles whose Gaussians fill several steps, of which some are dropped early."""
        g, camera = random_scene(3000, 3), default_camera(90, 70)
        g = replace(g, opacity_logits=np.where(g.means[:, 0] < 0, 8.0, -3.0))
        x = random_values(3000, 2)
        image, alpha = TorchRasterizer(torch.float64).view(g, camera).splat(x)
        want, want_alpha = ReferenceRasterizer().view(g, camera).splat(x)
        assert want_alpha.max() > 0.999  # stopped; 1 - 1e-4 is the most there is
        assert np.abs(image - want).max() < 1e-12
        assert np.abs(alpha - want_alpha).max() < 1e-12

    def test_gradients_are_the_cpu_backends(self):
        g, camera, x = random_gaussians(150, 4), random_camera(5), random_values(150, 3)
        y = np.random.default_rng(6).normal(size=(camera.height, camera.width, 3)).astype(np.float32)
        got = TorchRasterizer(torch.float64).view(g, camera).backward(x, y)
        want = CpuRasterizer().view(g, camera).backward(x, y)
        for name in ("means", "log_scales", "quats_wxyz", "opacity_logits", "values", "means_px"):
            assert_gradient(name, getattr(want, name), getattr(got, name))

    def test_invalid_rows_and_empty_pictures(self):
        g, camera = random_gaussians(20, 1), random_camera(2)
        means = g.means.copy()
        means[3] = np.nan
        broken = TorchRasterizer().view(replace(g, means=means), camera)
        assert broken.dropped == 1
        image, alpha = (
            TorchRasterizer().view(replace(g, means=g.means * 0 + 1e3), camera).splat(random_values(20, 3))
        )
        assert not image.any()
        assert not alpha.any()


class TestReferenceWindows:
    g, camera = random_gaussians(400, 7), random_camera(8, 150, 110)

    def test_windows_are_the_whole_reference(self):
        """Pixels off the windows are not looked at; those in them are equal up to the order of sums."""
        exact, x = reference_windows(self.g, self.camera), random_values(400, 3)
        whole = ReferenceRasterizer().view(self.g, self.camera)
        image = whole.splat(x)[0]
        band = whole.cut_off_band(1e-3)  # as wide as the benchmark's
        assert band.any()
        for window, got in zip(exact.windows, exact.splat(x), strict=True):
            assert np.abs(got - image[window.at]).max() < 1e-12
            assert np.array_equal(window.band, band[window.at])
        assert exact.splat_error(image, x).largest < 1e-12
        masked = exact.masked(np.random.default_rng(0).normal(size=image.shape).astype(np.float32))
        assert exact.gather_error(whole.gather(masked), masked).off_cuts < 1e-11  # sums of thousands

    def test_an_error_is_seen_and_a_flip_is_told_apart(self):
        exact, x = reference_windows(self.g, self.camera), random_values(400, 3)
        image = ReferenceRasterizer().view(self.g, self.camera).splat(x)[0]
        window = next(w for w in exact.windows if w.band.any() and not w.band.all())
        bad = image.copy()
        bad[window.at][window.band] += 0.25
        error = exact.splat_error(bad, x)
        assert error.largest == pytest.approx(0.25)
        assert error.off_cuts < 1e-12
        assert error.flips >= window.band.sum()
        bad[window.at][~window.band] += 0.125
        assert exact.splat_error(bad, x).off_cuts == pytest.approx(0.125)


class TestReport:
    def test_growth_recovers_exponents(self):
        rows = [measurement(n, 3e-4 * n**1.25) for n in (1000, 5000, 20_000, 90_000)]
        rows += [
            measurement(777, 0.5 * (w * h) ** 0.75, size=(w, h))
            for w, h in ((64, 48), (320, 240), (640, 480))
        ]
        found = {(g.by, g.points): g.exponent for g in bench_report.growth(rows)}
        assert found[("Gaussians", 5)] != found[("pixels", 3)]  # 777 Gaussians at 320x240 belong to both
        assert found[("pixels", 3)] == pytest.approx(0.75)
        exact = bench_report.growth(rows[:4])
        assert [(g.by, g.exponent) for g in exact] == [("Gaussians", pytest.approx(1.25))]

    def test_two_points_are_no_fit(self):
        assert bench_report.growth([measurement(10, 1.0), measurement(20, 2.0)]) == []

    def test_ratios_say_met_missed_and_not_measured(self):
        rows = [
            measurement(31_000, 10.0),
            measurement(31_000, 14.0, "gather"),
            measurement(31_000, 9.0, "frozen splat"),
        ]
        by_text = {r.text: r for r in bench_report.ratios(rows)}
        gather = by_text["3 channels, 31k, 320x240: cpu gather / cpu splat"]
        frozen = by_text["3 channels, 31k, 320x240: cpu splat / cpu frozen splat"]
        assert (gather.ratio, gather.met) == (pytest.approx(1.4), True)
        assert (frozen.ratio, frozen.met) == (pytest.approx(10 / 9), False)
        assert by_text["3 channels, 31k, 320x240: pytorch frame / cpu frame"].met is None
        assert "not measured" in bench_report.ratio_table(list(by_text.values()))

    def test_sweep_has_every_pair_once_and_small_ones_first(self):
        pairs = sweep(
            (10, 1000, 100), ((8, 8), (4, 4), (16, 16)), 100, ((10, (4, 4)), (7, (4, 4)), (100, (9, 9)))
        )
        assert pairs == [
            (10, (4, 4)), (10, (8, 8)), (100, (4, 4)), (100, (8, 8)), (100, (16, 16)), (1000, (8, 8)),
        ]  # fmt: skip


def test_a_tiny_run_writes_three_sane_files(tmp_path):
    plan = RasterBenchConfig((60, 120, 200), ((40, 30),), 120, (1, 3))
    unfinished = []
    report = run_plan(plan, keep=unfinished.append)
    write_report(tmp_path, "raster", report.text, report.figures, lambda path: plot(report.rows, path))
    assert [part.machine["unfinished"][0] for part in unfinished] == ["1", "2", "3"]
    assert {row.gaussians for row in unfinished[0].rows} == {60}
    record = json.loads((tmp_path / "raster.json").read_text())
    rows = record["measurements"]
    cpu = {r["operation"] for r in rows if r["backend"] == "cpu"}
    assert {"project", "frame", "splat", "gather", "backward"} <= cpu
    assert {"project", "frame", "splat", "backward"} == {
        r["operation"] for r in rows if r["backend"] == "pytorch"
    }
    assert all(r["milliseconds"] > 0 and r["calls"] >= 1 for r in rows)
    exact = [
        r for r in rows if r["backend"] in ("cpu", "pytorch") and not r["operation"].startswith("frozen")
    ]
    # float32 blending of values in [0, 1]; gradients relative to their greatest entry.
    assert all(r["error_off_cuts"] < 2e-5 for r in exact if r["error_off_cuts"] is not None)
    frozen = [r for r in rows if r["operation"].startswith("frozen")]
    assert all(r["error_off_cuts"] < 2e-3 for r in frozen)  # weights in 16 bits
    assert {g["by"] for g in record["growth"]} == {"Gaussians"}  # one size only
    text = (tmp_path / "raster.md").read_text()
    for heading in ("# Rasterizers", "## Growth", "## Promised ratios", "pytorch"):
        assert heading in text
    assert Image.open(tmp_path / "raster.png").size[0] > 1000


def test_what_would_take_too_long_is_named(tmp_path):
    plan = RasterBenchConfig((60, 4000), ((40, 30),), 60, (1,), limit=1e-9)
    report = run_plan(plan)
    assert all(r.milliseconds is not None for r in report.rows if r.gaussians == 60)
    left_out = [r for r in report.rows if r.gaussians == 4000]
    assert left_out
    assert all(r.milliseconds is None and "expected" in r.note for r in left_out)
    assert "not run" in report.text


def test_a_peak_begins_anew():
    if restart_peak() is None:
        pytest.skip("this system does not tell")
    block = bytearray(200_000_000)
    block[::4096] = b"x" * len(block[::4096])
    del block
    assert peak_memory() > resident_memory() + 100_000_000
    restart_peak()
    assert peak_memory() < resident_memory() + 100_000_000
