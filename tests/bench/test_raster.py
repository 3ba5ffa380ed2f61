"""The rasterizer benchmark: its reference windows, promised ratios and files. No test looks at a time."""

import json

import numpy as np
import pytest
from PIL import Image

from langsplat_core.bench import RasterBenchConfig, peak_memory, resident_memory, restart_peak
from langsplat_core.bench import raster as bench_report
from langsplat_core.bench.measure import Measurement, reference_windows
from langsplat_core.bench.raster import plot, run_plan, sweep
from langsplat_core.cli.evaluate import write_report
from langsplat_core.raster.reference import ReferenceRasterizer
from tests.support.scenes import random_camera, random_gaussians, random_values

pytestmark = pytest.mark.long


def measurement(
    gaussians=100, milliseconds=1.0, operation="splat", backend="cpu", size=(320, 240), channels=3
):
    return Measurement("random", gaussians, *size, channels, operation, backend, milliseconds)


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
        assert by_text["12 channels, 200k, 960x720: cpu splat / cpu splat, 3 channels"].met is None
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
    assert all(r["milliseconds"] > 0 and r["calls"] >= 1 for r in rows)
    exact = [r for r in rows if r["backend"] == "cpu" and not r["operation"].startswith("frozen")]
    # float32 blending of values in [0, 1].
    assert all(r["error_off_cuts"] < 2e-5 for r in exact if r["error_off_cuts"] is not None)
    assert all(r["error_off_cuts"] is not None for r in exact if r["operation"] == "backward")
    frozen = [r for r in rows if r["operation"].startswith("frozen")]
    assert all(r["error_off_cuts"] < 2e-3 for r in frozen)  # weights in 16 bits
    text = (tmp_path / "raster.md").read_text()
    for heading in ("# Rasterizers", "## Promised ratios"):
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
