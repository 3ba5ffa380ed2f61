"""The benchmark on procedural rooms: the whole command on a tiny room."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from langsplat_core.cli.evaluate import EvalSynthetic
from langsplat_core.cli.run import main
from langsplat_core.config import CodebookConfig, DatasetConfig
from langsplat_core.datasets import load_capture
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.scenes import save_scene
from langsplat_core.lab.config import BenchmarkConfig, GainBenchConfig, LiftBenchConfig, PaperBenchConfig
from langsplat_core.lab.demo import SEED
from langsplat_core.lab.rooms import patches, tiles
from langsplat_core.lab.rooms import scoring as synthetic
from langsplat_core.lab.rooms.benchmark import run_benchmark
from langsplat_core.lab.rooms.gain_bench import gain_table, measure_gains
from langsplat_core.lab.rooms.gains import GAINS
from langsplat_core.lab.rooms.lifting import measure_liftings, plot
from langsplat_core.lab.rooms.oracles import (
    MIN_REGION,
    TruthMasks,
)
from langsplat_core.lab.rooms.paper_tables import measure_paper
from langsplat_core.lab.rooms.room import HOLD_OUT, Room, weights_digest
from langsplat_core.lab.rooms.truth import read_truth
from langsplat_core.lab.rooms.variants import liftings, variants
from langsplat_core.lab.world import photographs as dataset
from langsplat_core.progress import silent
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import load_encoder
from langsplat_core.semantics.masks import label_maps

pytestmark = pytest.mark.long

TINY = BenchmarkConfig(
    tiers=("separate",),
    views=8,
    size=(64, 48),
    steps=60,
    max_gaussians=3_000,
    budget=True,
    codec=CodebookConfig(),
)


def written(folder):
    """Every file and when it was written."""
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The whole command on a tiny room: its output, its figures, and its work folder."""
    folder = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "LIGHT_SAMPLES", 2)
        patch.setattr(dataset, "LIGHT_CELL", 0.0)
        patch.setattr(synthetic, "MIN_PIXELS", 12)
        command = EvalSynthetic(TINY, work=folder / "work", json=folder / "figures.json")
        command.run()
        first = written(folder / "work")
        command.run()
        second = written(folder / "work")
    return SimpleNamespace(
        room=folder / "work" / "separate-101-8x64x48",
        first=first,
        second=second,
        work=folder / "work",
        figures=json.loads((folder / "figures.json").read_text()),
    )


@pytest.fixture(scope="module")
def capture(run):
    photographs = run.room / "photographs"
    return load_capture(photographs, DatasetConfig(max_side=64), run.room, silent)


def test_the_command_measures_every_stage(run):
    (room,) = run.figures["rooms"]
    assert (room["views"], room["held_out"]) == (7, 1)
    assert [row["name"] for row in room["measured"]] == [v.name for v in variants(TINY, 512)]
    for row in room["measured"]:
        assert sum(score["queries"] for score in row["scores"]) > 3
        assert all(0 <= score["mean_iou"] <= 1 for score in [*row["scores"], *row["direct"]])
        assert row["absent"] > 0
        assert row["query_ms"] > 0
    assert run.figures["settings"]["seeds"] == [101]


def test_rows_differ_in_the_named_stage(run):
    by_name = {row["name"]: row for row in run.figures["rooms"][0]["measured"]}
    ours = by_name["the method"]
    # The paper's order asks the very same field and reads it by the peak; another codec is another field.
    decoded, paper = by_name["autoencoder, d = 3"], by_name["autoencoder, the paper's order"]
    assert decoded["codec_loss"] == paper["codec_loss"]
    asked = [[(score["kind"], score["phrases"]) for score in row["direct"]] for row in (decoded, paper)]
    assert asked[0] == asked[1]
    assert decoded["direct"] != paper["direct"]
    assert by_name["no codec"]["codec"] == "linear 512"
    errors = [by_name[name]["codec_loss"]["error_mean"] for name in ("no codec", "the method")]
    assert errors[0] < 1e-5 < errors[1] < decoded["codec_loss"]["error_mean"]
    assert (ours["bytes_per_gaussian"], decoded["bytes_per_gaussian"]) == (6, 36)
    assert ours["codec"].startswith("codebook ")


def test_a_second_run_makes_nothing_again(run):
    assert run.first == run.second


@pytest.mark.parametrize("masks", ["truth", "graph"])
def test_variants_swap_one_stage_at_a_time(masks):
    config = replace(TINY, masks=masks)
    method, *others = (asdict(variant) for variant in variants(config, 512))
    swapped = [{key for key in method if key != "name" and method[key] != other[key]} for other in others]
    expected = [{"vectors"}, {"codec"}, {"codec"}, {"codec", "query"}]
    assert swapped == ([{"masks"}] if masks == "graph" else []) + expected
    assert len(variants(replace(config, budget=False), 512)) == 1
    both = variants(replace(config, budget=False, ceiling=True), 512)
    assert [variant.codec.latent_dim for variant in both if variant.name == "no codec"] == [512]


def test_truth_masks_are_the_truth(run, capture):
    truth = read_truth(run.room / "photographs")
    source = TruthMasks(capture, truth)
    for image, camera in zip(capture.images[:3], capture.cameras, strict=False):
        ids = truth.labels(camera.name)
        for level, rows in zip(ids, label_maps(source(image, silent)), strict=True):
            expected = {n: level == n for n in np.unique(level[level >= 0])}
            expected = {n: mask for n, mask in expected.items() if mask.sum() >= MIN_REGION}
            got = [rows == row for row in np.unique(rows[rows >= 0])]
            assert len(got) == len(expected) > 0
            assert {mask.tobytes() for mask in got} == {mask.tobytes() for mask in expected.values()}


def test_truth_masks_refuse_a_strange_photograph(run, capture):
    source = TruthMasks(capture, read_truth(run.room / "photographs"))
    with pytest.raises(InputError, match="no truth for this photograph"):
        source(255 - capture.images[0], silent)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (EvalSynthetic(replace(TINY, seeds=(101, SEED))), "bundled scene's room"),
        (EvalSynthetic(replace(TINY, seeds=())), "at least one"),
        (EvalSynthetic(replace(TINY, views=5)), "--views 5: must be 8 to"),
        (EvalSynthetic(scene="a.ply"), "belong together"),
        (EvalSynthetic(TINY, paper_order=True), "needs --scene"),
    ],
)
def test_mistakes_end_with_one_line(command, message, capsys):
    assert main("langsplat", lambda: command) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_the_bundled_seed_is_refused_before_any_work(tmp_path):
    with pytest.raises(InputError, match="another seed"):
        run_benchmark(replace(TINY, seeds=(SEED,)), tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_scene_mode_still_measures_a_pair(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(synthetic, "MIN_PIXELS", 12)
    encoder = load_encoder("demo"), weights_digest("demo")
    room = Room(TINY, "separate", 101, run.work, encoder, silent)
    field, _, _ = room.field(variants(TINY, 512)[0])
    train, _ = room.capture.split(HOLD_OUT)
    path = tmp_path / "scene.ply"
    save_scene(path, Scene(room.gaussians, field, tuple(room.capture.cameras[i] for i in train)))
    EvalSynthetic(scene=path, dataset=run.room / "photographs").run()
    assert "absent objects rejected" in capsys.readouterr().out


def test_ways_of_lifting_are_compared_in_one_room(run, tmp_path):
    config = LiftBenchConfig(
        "separate", 101, ("truth",), (3,), (8,), (32,), codec_steps=40, gradient_steps=20
    )
    kept = tmp_path / "rows.jsonl"
    report = measure_liftings(config, run.work, rooms=TINY, kept=kept)
    again = measure_liftings(config, run.work, rooms=TINY, kept=kept)
    assert again.rows == report.rows  # seconds too: nothing was made again
    kept.write_text(kept.read_text()[:-20])
    with pytest.raises(FormatError, match="delete it"):
        measure_liftings(config, run.work, rooms=TINY, kept=kept)
    names = [variant.name for variant in liftings(config, "truth", 512)]
    assert [(row.masks, row.name) for row in report.rows] == [("truth", name) for name in names]
    by_name = {row.name: row for row in report.rows}
    assert by_name["median, codebook K = 32"].bytes_per_gaussian == 6
    assert by_name["median, all 512 numbers"].codec_loss.error_mean < 1e-5
    assert by_name["paper: Adam from zeros"].peaks != by_name["paper: Adam from one-pass"].peaks
    assert report.text.count("\n") == 2 + len(report.rows)
    plot(report.rows, tmp_path / "lift.png")
    assert Image.open(tmp_path / "lift.png").size[0] > 500


def test_changes_of_the_lifting_are_compared_with_none(run, tmp_path, monkeypatch):
    config = GainBenchConfig("separate", (101,), ("wrong",), size=32)
    kept = tmp_path / "gains.rows.jsonl"
    rows = measure_gains(config, run.work, rooms=TINY, kept=kept)
    monkeypatch.setattr(Room, "measure_field", None)
    assert measure_gains(config, run.work, rooms=TINY, kept=kept) == rows  # all from the file
    assert [row.change for row in rows] == list(GAINS)
    table = gain_table(rows)
    assert table.count("\n") == 2 + len(GAINS)
    assert "1 of 1" in table or "0 of 1" in table
    with pytest.raises(InputError, match="--seeds"):
        measure_gains(replace(config, seeds=()), run.work)


def test_the_papers_ways_are_compared_with_lerfs(run, monkeypatch):
    monkeypatch.setattr(patches, "SCALES", (0.3, 0.5))  # of the smallest there are thousands in every picture
    monkeypatch.setattr(tiles, "SIDES", (1 / 8, 1 / 4, 1 / 2))
    chosen = ("LERF", "in one pass", "subpart alone", "squares")
    config = PaperBenchConfig("separate", (101,), dims=(1,), codec_steps=40, only=chosen)
    lerf, paper, subpart, squares = (row.measured for row in measure_paper(config, run.work, rooms=TINY))
    assert (lerf.query, paper.query, squares.masks) == ("blend answers", "paper", "tiles")
    assert lerf.bytes_per_gaussian == 2 * 512 * 4
    assert min(len(row.scores) for row in (lerf, paper, subpart, squares)) > 0
    assert min(row.frame_ms for row in (lerf, paper, subpart, squares)) > 0
    assert len({row.scores for row in (lerf, paper, subpart, squares)}) == 4
