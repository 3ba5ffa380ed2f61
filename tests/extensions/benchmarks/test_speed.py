"""The rasterizer benchmark: its reference windows and files; the query benchmark on a tiny
scene. No test looks at a time."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.cli.app import parse
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks.query_speed import BenchQuery, measure_queries, query_table
from langsplat_core.extensions.benchmarks.raster_speed import reference_windows, run_plan
from langsplat_core.extensions.benchmarks.report import write_report
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import CodebookCodec, LanguageField, Scene
from tests.support.fakes import DIM, PER_BLOB, FakeEncoder, axis, blob_scene
from tests.support.processes import Captured, check_full_disk, refusal, run
from tests.support.scenes import random_camera, random_gaussians, random_values


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


@pytest.mark.long
def test_a_tiny_run_writes_three_sane_files(tmp_path):
    sizes = ["--counts", "60", "120", "200", "--sizes", "40", "30", "--pivot", "120", "--channels", "1", "3"]
    command, unfinished = parse(["bench", "raster", *sizes, "--out", str(tmp_path)]), []
    run_plan(command, keep=unfinished.append)
    command.run()
    assert [part.machine["unfinished"][0] for part in unfinished] == ["1", "2", "3"]
    assert {row.gaussians for row in unfinished[0].rows} == {60}
    record = json.loads((tmp_path / "raster.json").read_text())
    rows = record["measurements"]
    cpu = {r["operation"] for r in rows if r["backend"] == "cpu"}
    assert {"project", "frame", "splat", "gather", "backward"} <= cpu
    assert all(r["milliseconds"] > 0 for r in rows)
    exact = [r for r in rows if r["backend"] == "cpu"]
    # float32 blending of values in [0, 1].
    assert all(r["error_off_cuts"] < 2e-5 for r in exact if r["error_off_cuts"] is not None)
    assert all(r["error_off_cuts"] is not None for r in exact if r["operation"] == "backward")
    text = (tmp_path / "raster.md").read_text()
    assert "# Rasterizers" in text
    assert Image.open(tmp_path / "raster.png").size[0] > 1000


# The query benchmark.

SMALL = BenchQuery(Path(), size=(40, 30), phrases=2, together=3, repeats=1, codec_steps=40)


def codebook_scene() -> Scene:
    """The three blobs, each with a codeword of its own at all levels."""
    codec = CodebookCodec(np.eye(3, DIM, dtype=np.float32), np.zeros((3, 3), np.float32))
    latents = np.tile(np.repeat(np.arange(3, dtype=np.uint16), PER_BLOB)[:, None], (3, 1, 1))
    confidence = np.ones((3, 3 * PER_BLOB), np.float32)
    confidence[0, :50] = 0
    field = LanguageField(latents, confidence, codec, np.tile(axis(3), (4, 1)), "fake")
    return replace(blob_scene(), language=field)


@pytest.mark.long
def test_every_order_is_measured_against_what_it_should_find():
    report = measure_queries(codebook_scene(), FakeEncoder(), SMALL)
    paper, table, codebook = report.costs
    assert (report.gaussians, report.size, report.phrases) == (3 * PER_BLOB, (40, 30), 3)
    assert [cost.way for cost in report.costs] == ["paper's order", "cells", "codebook"]
    assert codebook.lookup.p99 < 1e-6
    assert codebook.codec == codebook.lookup  # its latents stand for the codewords themselves
    assert 0 < table.lookup.mean < table.codec.mean  # 40 steps fit nothing; the table shows what they did
    assert table.codec.mean == pytest.approx(paper.codec.mean, rel=0.1)
    for cost in report.costs:
        assert min(cost.answer, cost.camera, cost.frame) >= 0  # seconds: how many is not for a test to say
        assert cost.way in query_table(report)


def test_a_scene_without_a_codebook_is_refused():
    with pytest.raises(InputError, match="codebook"):
        measure_queries(blob_scene(), FakeEncoder(), SMALL)


@pytest.mark.long
def test_the_command_writes_what_it_measured(tmp_path, capsys):
    small = "--size 64 48 --phrases 2 --together 2 --repeats 1 --codec-steps 30"
    words = ["bench", "query", "assets/demo/scene.ply", *small.split(), "--out", tmp_path]
    assert run(*words) == 0
    report = json.loads((tmp_path / "query.json").read_text())["report"]
    assert report["size"] == [64, 48]
    assert report["costs"][2]["lookup"]["p99"] < 1e-6
    assert (tmp_path / "query.md").read_text() in capsys.readouterr().out
    assert run(*words, "--repeats", 0) == 2


@pytest.mark.parametrize(
    "words",
    [
        *("eval lerf-ovs s.ply d --json /proc/x.json", "eval 3d-ovs s.ply d --json /proc/x"),
        *("bench raster --out /proc/x", "bench query s.ply --out /proc/x"),
    ],
)
def test_commands_try_the_place_to_write_first(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "system's own" in refusal(capsys, *words.split())


def write(folder: Path) -> None:
    write_report(folder, "r", "text", list(range(999)))


def test_a_full_disk_is_one_line(tmp_path: Path, capsys: Captured) -> None:
    check_full_disk(write, tmp_path, capsys, b"what was there before")
