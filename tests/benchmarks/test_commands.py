"""The whole commands, on a tiny room and on small sizes."""

import json
import tempfile
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from assets.making import dataset
from assets.making.dataset import MIN_REGION, SEED, TruthMasks, read_truth
from langsplat_core.cli.run import main
from langsplat_core.config import DatasetConfig, numeric_settings
from langsplat_core.datasets import load_capture
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import silent
from langsplat_core.semantics.masks import label_maps
from tests.benchmarks import scoring
from tests.benchmarks.__main__ import PROGRAM, parse
from tests.benchmarks.answers import (
    Lifting,
    Rooms,
    measure_methods,
    measure_verdicts,
    method_table,
    variants,
)
from tests.benchmarks.phrases import Phrases
from tests.benchmarks.room import RoomSettings, Variant
from tests.benchmarks.scale import COARSE
from tests.support.fakes import blob_scene

SETTINGS = RoomSettings(views=8, size=(64, 48), steps=60, max_gaussians=3_000)
TINY = Rooms(tiers=("separate",), seeds=(101,), settings=SETTINGS, budget=True, codec_steps=60)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The whole command on a tiny room: its output, its figures, and its work folder."""
    folder = tmp_path_factory.mktemp("benchmark")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "LIGHT_SAMPLES", 2)
        patch.setattr(dataset, "LIGHT_CELL", 0.0)
        patch.setattr(scoring, "MIN_PIXELS", 12)
        command = replace(TINY, work=folder / "work", out=folder / "out")
        written = []
        for _ in range(2):
            command.run()
            written.append({p: p.stat().st_mtime_ns for p in command.work.rglob("*") if p.is_file()})
        (room,) = command.rooms(silent)
        yield SimpleNamespace(
            room=room,
            written=written,
            work=command.work,
            photographs=command.work / "separate-101-8x64x48" / "photographs",
            page=(folder / "out" / "rooms.md").read_text(),
            figures=json.loads((folder / "out" / "rooms.json").read_text()),
        )


@pytest.mark.long
def test_rooms_measure_every_stage_once(run):
    (room,) = run.figures["rows"]
    assert (room["views"], room["held_out"]) == (7, 1)
    by_name = {row["name"]: row for row in room["measured"]}
    names = [variant.name for variant in variants(TINY, 512)]
    assert list(by_name) == names
    assert all(f"| {name} |" in run.page for name in names[1:])
    for row in by_name.values():
        assert sum(score["queries"] for score in row["scores"]) > 3
        assert all(0 <= score["mean_iou"] <= 1 for score in [*row["scores"], *row["direct"]])
        assert min(row["absent"], row["query_ms"]) > 0
    method, _, exact, decoded, paper = by_name.values()
    # The paper's order asks the very same field and reads it by the peak; another codec is another field.
    assert decoded["codec_loss"] == paper["codec_loss"]
    assert decoded["direct"] != paper["direct"]
    errors = [row["codec_loss"]["error_mean"] for row in (exact, method, decoded)]
    assert errors[0] < 1e-5 < errors[1] < errors[2]
    assert (method["bytes_per_gaussian"], decoded["bytes_per_gaussian"]) == (6, 36)
    first, second = run.written
    assert first == second  # nothing was made again


@pytest.mark.long
def test_truth_masks_are_the_regions_of_the_truth(run):
    capture = load_capture(run.photographs, DatasetConfig(max_side=64), run.room.folder, silent)
    truth = read_truth(run.photographs)
    source = TruthMasks(capture, truth)
    for image, camera in zip(capture.images[:3], capture.cameras, strict=False):
        ids = truth.labels(camera.name)
        for level, rows in zip(ids, label_maps(source(image, silent)), strict=True):
            expected = {n: level == n for n in np.unique(level[level >= 0])}
            expected = {n: mask for n, mask in expected.items() if mask.sum() >= MIN_REGION}
            got = [rows == row for row in np.unique(rows[rows >= 0])]
            assert len(got) == len(expected) > 0
            assert {mask.tobytes() for mask in got} == {mask.tobytes() for mask in expected.values()}
    with pytest.raises(InputError, match="no truth for this photograph"):
        source(255 - capture.images[0], silent)


@pytest.mark.parametrize(
    "words",
    [
        f"rooms --seeds 101 {SEED}",
        "phrases --seeds",
        "rooms --tiers",
        "rooms --views 5",
        "rooms --codec.kind autoencoder --codec.batch 1",
        "rooms --encoder clip-geometry:0.9",
        "scale --rows 0",
    ],
)
def test_mistakes_end_with_one_line(words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(PROGRAM, lambda: parse(words.split())) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["rooms", "verdicts", "phrases", "lifting", "scale"])
def test_every_number_of_a_report_has_a_range(name):
    assert [setting.option for setting in numeric_settings(parse([name])) if setting.range is None] == []


@pytest.mark.long
def test_verdicts_and_phrases_measure_the_same_room(run, tmp_path):
    rows = measure_verdicts(run.room, Variant("the method", "truth", codec=TINY.codec))
    assert {"object", "absent", "part", "absent part"} <= {row.kind for row in rows}
    Phrases(("separate",), (101,), SETTINGS, run.work, tmp_path).run()
    figures = json.loads((tmp_path / "phrases.json").read_text())["rows"]
    assert {row["way"] for row in figures if "way" in row} == {"whole", "composed"}
    (named,) = [row for row in figures if "inventory" in row]
    assert {row["level"] for row in named["names"]} == {"subpart", "part", "whole"}


@pytest.mark.long
def test_lifting_compares_methods(run):
    command = Lifting(("separate",), (101,), SETTINGS, codec_steps=40, gradient_steps=20)
    chosen = replace(command, only=("trained", "d = 1", "codebook of 256", "subpart alone"))
    rows = list(measure_methods(run.room, chosen))
    trained, zeros, one_pass, codebook, subpart = (row.measured for row in rows)
    assert (one_pass.query, codebook.bytes_per_gaussian) == ("paper", 6)
    assert trained.peaks != zeros.peaks
    assert len({row.scores for row in (trained, codebook, subpart)}) == 3
    assert method_table(rows).count("\n") == 2 + len(rows)
    with pytest.raises(InputError, match="--only nothing"):
        list(measure_methods(run.room, replace(command, only=("nothing",))))


SMALL = """scale --rows 5001 --repeats 1 --moving 0 --moving-size 160 100
--views 2 --count 3000 --size 40 30 --images 2 --phrases 9"""


@pytest.mark.long
def test_scale_measures_every_part_at_small_sizes(tmp_path, monkeypatch):
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    assert main(PROGRAM, lambda: parse([*SMALL.split(), "--out", str(tmp_path)])) == 0
    assert not list((tmp_path / "temporary").iterdir())
    rows = json.loads((tmp_path / "scale.json").read_text())["rows"]
    ours, theirs = (row for row in rows if "reader" in row)
    assert (ours["reader"], theirs["reader"], theirs["same"]) == ("langsplat", "plyfile", True)
    assert ours["kept_bytes"] == theirs["kept_bytes"] == 5001 * 59 * 4
    costs = [row for row in rows if "psnr" in row]
    assert tuple((cost["scale"], cost["merged"]) for cost in costs) == COARSE
    full, half, quarter, half_merged, quarter_merged = costs
    assert full["psnr"] == 100 > half["psnr"] > quarter["psnr"] > 10
    assert half_merged["psnr"] > quarter_merged["psnr"] > 10
    assert full["gaussians"] == half["gaussians"] > 2 * half_merged["gaussians"]
    stretches = [row for row in rows if "what" in row]
    assert [row["times"] for row in stretches if "phrase" in row["what"]] == [1, 2, 2, 2, 2]
    assert sum(row["times"] for row in stretches if "image" in row["what"]) == 3


@pytest.mark.long
@pytest.mark.parametrize("lack", ["field", "with_cameras"])
def test_scale_refuses_scenes_without_field_or_cameras(lack, tmp_path, capsys):
    path = tmp_path / "scene.ply"
    save_scene(path, blob_scene(**{lack: False}))
    for part in ("moving", "endurance"):
        words = ["scale", str(path), "--only", part, "--out", str(tmp_path / "out")]
        assert main(PROGRAM, lambda words=words: parse(words)) == 2
        assert str(path) in capsys.readouterr().err
