"""The whole commands, on a tiny room and on small sizes."""

import json
import tempfile
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from assets.making import dataset
from assets.making.scene import SEED
from assets.making.truth import MIN_REGION, TruthMasks, read_truth
from langsplat_core.cli.run import main
from langsplat_core.config import DatasetConfig, numeric_settings
from langsplat_core.datasets import load_capture
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.scenes import save_scene
from langsplat_core.progress import silent
from langsplat_core.scene import Scene
from langsplat_core.semantics.masks import label_maps
from tests.benchmarks import lifting, oracles, scoring
from tests.benchmarks.__main__ import PROGRAM, parse
from tests.benchmarks.answers import Rooms, measure_verdicts, variants
from tests.benchmarks.lifting import KeptRows, Lifting, measure_methods, method_table, plot
from tests.benchmarks.phrases import Phrases
from tests.benchmarks.room import HOLD_OUT, RoomSettings, Variant
from tests.benchmarks.scale import COARSE
from tests.support.fakes import blob_scene

SETTINGS = RoomSettings(views=8, size=(64, 48), steps=60, max_gaussians=3_000)
TINY = Rooms(tiers=("separate",), seeds=(101,), settings=SETTINGS, budget=True, codec_steps=60)
DECODED, PAPER = "autoencoder, d = 3", "autoencoder, the paper's order"
BUDGET = ("the method", "perfect embeddings", "no codec", DECODED, PAPER)


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
        patch.setattr(scoring, "MIN_PIXELS", 12)
        command = replace(TINY, work=folder / "work", out=folder / "out")
        command.run()
        first = written(folder / "work")
        command.run()
        second = written(folder / "work")
        (room,) = command.rooms(silent)
        yield SimpleNamespace(
            room=room,
            first=first,
            second=second,
            work=folder / "work",
            photographs=folder / "work" / "separate-101-8x64x48" / "photographs",
            page=(folder / "out" / "rooms.md").read_text(),
            figures=json.loads((folder / "out" / "rooms.json").read_text()),
        )


@pytest.fixture(scope="module")
def capture(run):
    return load_capture(run.photographs, DatasetConfig(max_side=64), run.room.folder, silent)


@pytest.mark.long
def test_the_command_measures_every_stage(run):
    (room,) = run.figures["rows"]
    assert (room["views"], room["held_out"]) == (7, 1)
    assert tuple(row["name"] for row in room["measured"]) == BUDGET
    for row in room["measured"]:
        assert sum(score["queries"] for score in row["scores"]) > 3
        assert all(0 <= score["mean_iou"] <= 1 for score in [*row["scores"], *row["direct"]])
        assert row["absent"] > 0
        assert row["query_ms"] > 0
    assert run.figures["settings"]["seeds"] == [101]
    assert all(f"| {name} |" in run.page for name in BUDGET[1:])


@pytest.mark.long
def test_rows_differ_in_the_named_stage(run):
    by_name = {row["name"]: row for row in run.figures["rows"][0]["measured"]}
    ours = by_name["the method"]
    # The paper's order asks the very same field and reads it by the peak; another codec is another field.
    decoded, paper = by_name[DECODED], by_name[PAPER]
    assert decoded["codec_loss"] == paper["codec_loss"]
    asked = [[(score["kind"], score["phrases"]) for score in row["direct"]] for row in (decoded, paper)]
    assert asked[0] == asked[1]
    assert decoded["direct"] != paper["direct"]
    assert by_name["no codec"]["codec"] == "linear 512"
    errors = [by_name[name]["codec_loss"]["error_mean"] for name in ("no codec", "the method")]
    assert errors[0] < 1e-5 < errors[1] < decoded["codec_loss"]["error_mean"]
    assert (ours["bytes_per_gaussian"], decoded["bytes_per_gaussian"]) == (6, 36)
    assert ours["codec"].startswith("codebook ")


@pytest.mark.long
def test_a_second_run_makes_nothing_again(run):
    assert run.first == run.second


@pytest.mark.parametrize("masks", ["truth", "graph"])
def test_variants_swap_one_stage_at_a_time(masks):
    command = replace(TINY, masks=masks)
    method, *others = (asdict(variant) for variant in variants(command, 512))
    swapped = [{key for key in method if key != "name" and method[key] != other[key]} for other in others]
    expected = [{"vectors"}, {"codec"}, {"codec"}, {"codec", "query"}]
    assert swapped == ([{"masks"}] if masks == "graph" else []) + expected
    assert len(variants(replace(command, budget=False), 512)) == 1


@pytest.mark.long
def test_truth_masks_are_the_truth(run, capture):
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
    ("words", "message"),
    [
        (f"rooms --seeds 101 {SEED}", "bundled scene's room"),
        (f"verdicts --seeds {SEED}", "bundled scene's room"),
        ("phrases --seeds", "give at least one number"),
        ("rooms --tiers", "at least one of --tiers"),
        ("rooms --views 5", "--views 5: must be 8 to"),
        ("rooms --codec.kind autoencoder --codec.batch 1", "--codec.batch 1"),
        ("rooms --scene a.ply", "belong together"),
        ("rooms --encoder clip-geometry:0.9", "no vectors have these cosines"),
        ("scale --lifted 0 2", "--lifted 0 2"),
    ],
)
def test_mistakes_end_with_one_line(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(PROGRAM, lambda: parse(words.split())) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["rooms", "verdicts", "phrases", "lifting", "scale"])
def test_every_number_of_every_report_has_a_range(name):
    assert [setting.option for setting in numeric_settings(parse([name])) if setting.range is None] == []


@pytest.mark.long
def test_a_given_scene_is_measured_against_its_room(run, tmp_path, capsys):
    field, _, _ = run.room.field(variants(TINY, 512)[0])
    train, _ = run.room.capture.split(HOLD_OUT)
    path = tmp_path / "scene.ply"
    cameras = tuple(run.room.capture.cameras[i] for i in train)
    save_scene(path, Scene(run.room.gaussians, field, cameras))
    Rooms(scene=path, dataset=run.photographs).run()
    assert "absent objects rejected" in capsys.readouterr().out


@pytest.mark.long
def test_verdicts_and_phrases_are_asked_of_the_same_room(run, tmp_path):
    rows = measure_verdicts(run.room, Variant("the method", "truth", codec=TINY.codec))
    assert {"object", "absent", "part", "absent part"} <= {row.kind for row in rows}
    Phrases(("separate",), (101,), SETTINGS, run.work, tmp_path).run()
    figures = json.loads((tmp_path / "phrases.json").read_text())["rows"]
    assert {row["way"] for row in figures if "way" in row} == {"whole", "composed"}
    (named,) = [row for row in figures if "inventory" in row]
    assert {row["level"] for row in named["names"]} == {"subpart", "part", "whole"}


LIFTING = Lifting(("separate",), (101,), SETTINGS, codec_steps=40, gradient_steps=20)


@pytest.mark.long
def test_methods_are_compared_in_one_room(run, tmp_path, monkeypatch):
    monkeypatch.setattr(lifting, "SCALES", (0.3, 0.5))  # of the smallest there are thousands in every image
    monkeypatch.setattr(oracles, "SIDES", (1 / 8, 1 / 4, 1 / 2))
    command = replace(
        LIFTING, only=("LERF", "trained", "d = 1", "codebook of 256", "all 512", "subpart alone", "squares")
    )
    kept = tmp_path / "lifting.rows.jsonl"
    rows = list(measure_methods(run.room, command, KeptRows(kept)))
    again = list(measure_methods(run.room, command, KeptRows(kept)))
    assert again == rows  # seconds too: nothing was made again
    by_name = {row.measured.name: row.measured for row in rows}
    trained, zeros, one_pass, codebook, everything, subpart, squares, lerf = by_name.values()
    assert (lerf.query, one_pass.query, squares.masks) == ("blend answers", "paper", "tiles")
    assert lerf.bytes_per_gaussian == 2 * 512 * 4
    assert codebook.bytes_per_gaussian == 6
    assert everything.codec_loss.error_mean < 1e-5
    assert trained.peaks != zeros.peaks
    assert min(min(row.frame_ms, len(row.scores)) for row in by_name.values()) > 0
    assert len({row.scores for row in (lerf, trained, subpart, squares)}) == 4
    assert method_table(rows).count("\n") == 2 + len(rows)
    times = {row.measured.name: row.image_ms for row in rows}  # the image of LERF is the answer
    assert times[lerf.name] == lerf.frame_ms
    assert times[codebook.name] == codebook.frame_ms + codebook.query_ms
    plot(rows, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as drawn:
        assert np.asarray(drawn.convert("L")).std() > 5
    with pytest.raises(InputError, match="--only nothing: no method has that; they are ours"):
        list(measure_methods(run.room, replace(LIFTING, only=("nothing",)), KeptRows(kept)))
    kept.write_text(kept.read_text()[:-20])
    with pytest.raises(FormatError, match="delete it"):
        KeptRows(kept)


# -- large sizes, made small: no figure is asserted --

SMALL = """scale --rows 5001 --repeats 1 --lifted 400 2 --picture 64 48 --moving 0 --moving-size 160 100
--views 2 --count 3000 --size 40 30 --images 2 --phrases 9"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The whole report: its page, and its figures by their first field."""
    folder = tmp_path_factory.mktemp("scale")
    (folder / "temporary").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder / "temporary"))
        assert main(PROGRAM, lambda: parse([*SMALL.split(), "--out", str(folder)])) == 0
    assert not list((folder / "temporary").iterdir())
    return (folder / "scale.md").read_text(), json.loads((folder / "scale.json").read_text())["rows"]


@pytest.mark.long
def test_both_readers_give_the_same_arrays(report):
    loadings = [row for row in report[1] if "reader" in row]
    assert [row["reader"] for row in loadings] == ["langsplat", "plyfile"]
    assert all(row["same"] and row["seconds"] > 0 for row in loadings)
    assert {row["kept_bytes"] for row in loadings} == {5001 * 59 * 4}
    assert loadings[0]["file_bytes"] > 5001 * 62 * 4


@pytest.mark.long
def test_lifting_is_measured_in_a_process_of_its_own(report):
    (cost,) = [row for row in report[1] if "relevancy_error" in row]
    assert (cost["gaussians"], cost["views"]) == (400, 2)
    assert cost["kept_bytes"] > 0


@pytest.mark.long
def test_coarser_images_are_farther_off(report):
    costs = [row for row in report[1] if "psnr" in row]
    assert tuple((cost["scale"], cost["merged"]) for cost in costs) == COARSE
    full, half, quarter, half_merged, quarter_merged = costs
    assert (full["psnr"], full["error"]) == (100, 0)
    assert 100 > half["psnr"] > quarter["psnr"] > 10
    assert half_merged["psnr"] > quarter_merged["psnr"] > 10
    assert full["gaussians"] == half["gaussians"] > 2 * half_merged["gaussians"]


@pytest.mark.long
def test_a_long_session_is_measured_part_by_part(report):
    rows = [row for row in report[1] if "what" in row]
    assert [row["times"] for row in rows if "phrase" in row["what"]] == [1, 2, 2, 2, 2]
    assert sum(row["times"] for row in rows if "image" in row["what"]) == 3
    assert report[0].count("\n## ") == 4


@pytest.mark.long
def test_a_scene_without_meaning_or_cameras_is_refused(tmp_path, capsys):
    for name, scene in (("plain", blob_scene(field=False)), ("bare", blob_scene(with_cameras=False))):
        save_scene(tmp_path / f"{name}.ply", scene)
        for part in ("moving", "endurance"):
            words = ["scale", str(tmp_path / f"{name}.ply"), "--only", part, "--out", str(tmp_path / "out")]
            assert main(PROGRAM, lambda words=words: parse(words)) == 2
    said = capsys.readouterr().err
    assert said.count("no language field") == said.count("no cameras") == 2
