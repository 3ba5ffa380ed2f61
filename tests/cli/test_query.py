"""`langsplat query`."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from plyfile import PlyData

from langsplat_core.arrays import Array
from langsplat_core.cli import query, select
from langsplat_core.cli.app import parse
from langsplat_core.cli.query import QueryScene
from langsplat_core.cli.run import main
from langsplat_core.cli.scenes import Scale
from langsplat_core.config import INRIA
from langsplat_core.errors import EncoderError, InputError, LangSplatError
from langsplat_core.io import load_scene, save_scene
from langsplat_core.lab.rooms.scoring import ask, evaluate
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_rasterizer
from langsplat_core.scene import Reading, Scene
from langsplat_core.semantics.encoder import OPEN_MODEL
from tests.support.blob_words import NAMES, named_scene
from tests.support.fakes import CENTRES, PER_BLOB, FakeEncoder, axis, blob_scene, blobs, calibrated_for
from tests.support.fakes import cameras as fake_cameras
from tests.support.fakes import language as fake_language


class Recorder:
    """The CPU rasterizer, which notes the settings it is given."""

    def __init__(self) -> None:
        self.seen: list = []

    def view(self, gaussians, camera, settings=INRIA):
        self.seen.append(settings)
        return load_rasterizer("cpu").view(gaussians, camera, settings)


@pytest.mark.parametrize("antialiased", [False, True])
def test_queries_and_evaluation_draw_as_the_file_says(tmp_path, monkeypatch, antialiased):
    scene = Scene(blobs(), fake_language(phrasebook=True), fake_cameras(1), None, antialiased)
    save_scene(tmp_path / "a.ply", scene)
    recorder = Recorder()
    monkeypatch.setattr(query, "load_rasterizer", lambda _: recorder)
    QueryScene(tmp_path / "a.ply", ("book",)).run()
    truth = SimpleNamespace(phrases=(), labels=lambda name: np.zeros((3, 120, 160), int))
    evaluate(ask(QueryEngine(load_scene(tmp_path / "a.ply")), ()), recorder, scene.cameras, truth)
    assert [settings.antialiased for settings in recorder.seen] == [antialiased] * 2


ASK = """
import sys
from langsplat_core.cli.app import entry
sys.argv = ["langsplat", "query", "a.ply", "  Book ", "PLANT  pot"]
try:
    entry()
except SystemExit as stop:
    assert not stop.code, stop.code
print([name for name in ("torch", "transformers") if name in sys.modules])
"""


@pytest.mark.long
def test_phrases_of_the_phrasebook_need_no_encoder(tmp_path):
    """However they are written: loading one imports torch, which takes seconds."""
    field = fake_language(phrasebook=True)
    known = field.phrasebook | {"plant pot": axis(2)}
    save_scene(tmp_path / "a.ply", Scene(blobs(), replace(field, phrasebook=known), fake_cameras(1)))
    run = subprocess.run(
        [sys.executable, "-c", ASK], cwd=tmp_path, env=os.environ, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    book, _, first, pot, _, _, _, heavy = run.stdout.splitlines()
    assert book.startswith("Book: found")
    assert first.split()[0] == "1"
    assert pot.startswith("PLANT pot: found")
    assert heavy == "[]"


def test_another_phrase_is_answered_by_the_encoder_named(tmp_path, monkeypatch, capsys):
    save_scene(tmp_path / "a.ply", Scene(blobs(), fake_language(phrasebook=True)))
    loaded = []
    monkeypatch.setattr(query, "load_text_encoder", lambda name: loaded.append(name) or FakeEncoder())
    QueryScene(tmp_path / "a.ply", ("book",)).run()
    assert loaded == []
    QueryScene(tmp_path / "a.ply", ("book", "Mug", "plant"), encoder="mine").run()
    QueryScene(tmp_path / "a.ply", ("mug",)).run()
    assert loaded == ["mine", "fake"]
    assert "Mug: found" in capsys.readouterr().out


def test_an_unknown_word_is_said_first_and_the_rest_is_answered(tmp_path, monkeypatch, capsys):
    save_scene(tmp_path / "a.ply", Scene(blobs(), fake_language()))
    monkeypatch.setattr(query, "load_text_encoder", lambda name: FakeEncoder())
    QueryScene(tmp_path / "a.ply", ("mug", "plamt", "the", "book or sofa", '"book"'), json=True).run()
    out, err = capsys.readouterr()
    assert [answer["phrase"] for answer in json.loads(out)] == ["mug", "book"]
    plamt, the, sofa = err.splitlines()
    assert plamt.startswith(
        "langsplat: not asked: 'plamt': the encoder does not know 'plamt' (did you mean 'plant'?)"
    )
    assert "'the' names nothing" in the
    assert "'book or sofa': the encoder does not know 'sofa';" in sofa


def test_nothing_is_searched_before_all_is_checked(tmp_path, monkeypatch, capsys):
    save_scene(tmp_path / "a.ply", Scene(blobs(), fake_language()))
    monkeypatch.setattr(query, "load_text_encoder", lambda name: FakeEncoder())
    monkeypatch.setattr(QueryEngine, "relevancy", lambda *_: pytest.fail("searched"))
    for texts in (("sofa",), ("sofa", "the"), ("sofa; ?",)):
        with pytest.raises(LangSplatError, match="does not know 'sofa'"):
            QueryScene(tmp_path / "a.ply", texts).run()
    assert capsys.readouterr() == ("", "")


def test_an_encoder_that_cannot_be_loaded_is_tried_once(tmp_path, monkeypatch, capsys):
    save_scene(tmp_path / "a.ply", Scene(blobs(), fake_language(phrasebook=True)))
    tried = []

    def absent(name):
        tried.append(name)
        raise EncoderError("no weights here")

    monkeypatch.setattr(query, "load_text_encoder", absent)
    QueryScene(tmp_path / "a.ply", ("mug", "book", "plant")).run()
    out, err = capsys.readouterr()
    assert out.startswith("book: found")
    assert err == "langsplat: not asked: 'mug', 'plant': no weights here\n"
    assert len(tried) == 1


def test_commas_separate_phrases_and_exclusions_stay_one(tmp_path, monkeypatch, capsys):
    save_scene(tmp_path / "a.ply", Scene(blobs(), fake_language()))
    monkeypatch.setattr(query, "load_text_encoder", lambda name: FakeEncoder())
    QueryScene(tmp_path / "a.ply", ("mug, plant; mug or book, not book",), json=True).run()
    answers = json.loads(capsys.readouterr().out)
    assert [answer["phrase"] for answer in answers] == ["mug", "plant", "mug or book, not book"]
    assert answers[2]["reading"] == "(mug  or  book)  without  book"


def test_the_things_of_an_answer_are_listed(tmp_path, capsys):
    """Two of the three blobs mean "pair", in a scene whose unit is half a metre."""
    pair = ((axis(0) + axis(2)) / np.sqrt(2)).astype(np.float32)
    field = replace(fake_language(), phrasebook={"pair": pair, "void": axis(6)})
    save_scene(tmp_path / "a.ply", Scene(blobs(), field, metres_per_unit=0.5))
    QueryScene(tmp_path / "a.ply", ("pair", "void"), json=True).run()
    found, absent = json.loads(capsys.readouterr().out)
    assert absent["instances"] == []
    assert found["metres_per_unit"] == 0.5
    assert [thing["number"] for thing in found["instances"]] == [1, 2]
    centres = sorted(thing["centre"][0] for thing in found["instances"])
    np.testing.assert_allclose(centres, [-1.2, 1.2], atol=0.1)
    for thing in found["instances"]:
        rotation = np.array(thing["oriented_box"]["rotation"])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(thing["size"], 2 * np.array(thing["oriented_box"]["half_extents"]))
        assert 0.4 < thing["share"] < 0.6
    QueryScene(tmp_path / "a.ply", ("pair",), instances=1).run()
    verdict, heading, *rows, _ = capsys.readouterr().out.splitlines()
    assert " m, pixel" in verdict
    assert "centre, m" in heading
    (row,) = rows
    assert abs(float(row.split()[5])) == pytest.approx(0.6, abs=0.05)
    QueryScene(tmp_path / "a.ply", ("pair",), scale=1.0).run()
    assert abs(float(capsys.readouterr().out.splitlines()[2].split()[5])) == pytest.approx(1.2, abs=0.1)
    with pytest.raises(InputError, match="--scale -1"):
        QueryScene(tmp_path / "a.ply", ("pair",), scale=-1.0).run()


def asked(capsys, path, *texts: str, **options) -> tuple[list[str], list[dict]]:
    """Lines for people, and what JSON says."""
    QueryScene(path, texts, **options).run()
    lines = capsys.readouterr().out.splitlines()
    QueryScene(path, texts, json=True, **options).run()
    return lines, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("logit", "verdict", "probability"),
    [(9.0, "found", 1.0), (1.0, "weak match", 0.73), (-3.0, "not here", 0.05)],
)
def test_a_verdict_comes_with_its_probability(tmp_path, capsys, logit, verdict, probability):
    reading = Reading(calibration=calibrated_for("book", logit))
    field = replace(fake_language(phrasebook=True), reading=reading)
    save_scene(tmp_path / "a.ply", Scene(blobs(), field))
    lines, (answer,) = asked(capsys, tmp_path / "a.ply", "book")
    assert answer["probability"] == pytest.approx(probability, abs=0.01)
    percent = f"{100 * answer['probability']:.0f}"
    assert lines[0].startswith(f"book: {verdict} ({percent} %), score ")
    assert (answer["verdict"], answer["found"]) == (verdict, verdict == "found")
    assert (answer["instances"] == []) == (verdict != "found")


def test_without_a_calibration_there_is_no_probability(tmp_path, capsys):
    save_scene(tmp_path / "a.ply", Scene(blobs(), fake_language(phrasebook=True)))
    lines, (answer,) = asked(capsys, tmp_path / "a.ply", "book")
    assert lines[0].startswith("book: found, score ")
    assert (answer["probability"], answer["encoder"], answer["calibration"]) == (None, "fake", None)
    assert not any("%)" in line for line in lines)
    scene = replace(fake_language(phrasebook=True), encoder_id="demo")
    save_scene(tmp_path / "a.ply", Scene(blobs(), scene))
    lines, _ = asked(capsys, tmp_path / "a.ply", "book", "book")
    assert [f"--clip.model {OPEN_MODEL}" in line for line in lines] == [False] * (len(lines) - 1) + [True]


def test_structure_is_read_unless_the_phrase_is_asked_whole(tmp_path, capsys):
    field = replace(
        fake_language(), phrasebook={"mug": axis(0), "plant": axis(2), "mug near the plant": axis(1)}
    )
    save_scene(tmp_path / "a.ply", Scene(blobs(), field, fake_cameras(1)))
    lines, (answer,) = asked(capsys, tmp_path / "a.ply", "mug or plant")
    assert lines[0].startswith("mug or plant: found")
    assert lines[1] == f"  read as: {answer['reading']}" == "  read as: mug  or  plant"
    assert len(answer["instances"]) == 2
    lines, (answer,) = asked(capsys, tmp_path / "a.ply", "mug near the plant", whole=True)
    assert answer["reading"] is None
    assert not any("read as" in line for line in lines)
    assert answer["place"][0] == pytest.approx(0, abs=0.2)  # what the phrasebook says of the whole phrase
    _, (plain,) = asked(capsys, tmp_path / "a.ply", "plant")
    assert plain["reading"] is None


# `langsplat select` and `langsplat scale`.

@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a scene of a mug, a book and a plant. In its phrasebook are also "pair", both
    mug and plant, and "void", which is nothing."""
    scene = blob_scene(phrasebook=True)
    assert scene.language is not None
    pair = ((axis(0) + axis(2)) / np.sqrt(2)).astype(np.float32)
    known = dict(scene.language.phrasebook) | {"pair": pair, "void": axis(6)}
    extras = {"label": np.arange(len(scene.gaussians), dtype=np.int32)}
    language = replace(scene.language, phrasebook=known)
    save_scene(tmp_path / "a.ply", replace(scene, language=language, extras=extras, metres_per_unit=0.5))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(select, "load_text_encoder", lambda name: FakeEncoder())
    return tmp_path


def run(*words: str) -> int:
    return main("langsplat", lambda: parse(list(words)))


def blob_of(scene: Scene) -> list[int]:
    """How many Gaussians of each blob."""
    nearest = np.abs(scene.gaussians.means[:, :1] - CENTRES[:, 0]).argmin(1)
    return np.bincount(nearest, minlength=3).tolist()


def labels(scene: Scene) -> Array:
    return scene.extras["label"]


def test_a_thing_is_a_scene_of_its_own(folder, capsys):
    assert run("select", "a.ply", "mug", "--out", "mug.ply") == 0
    whole, mug = load_scene("a.ply"), load_scene("mug.ply")
    assert blob_of(mug)[1:] == [0, 0]
    assert 0.9 * PER_BLOB < len(mug.gaussians) <= PER_BLOB
    rows = labels(mug)
    np.testing.assert_array_equal(mug.gaussians.sh, whole.gaussians.sh[rows])
    assert mug.language is not None
    assert whole.language is not None
    np.testing.assert_array_equal(mug.language.latents, whole.language.latents[:, rows])
    assert set(mug.language.phrasebook) == {"book", "pair", "void"}
    assert len(mug.cameras) == len(whole.cameras)
    assert mug.metres_per_unit == 0.5
    assert QueryEngine(mug, lambda name: FakeEncoder()).run("mug").found
    assert "size, m" in capsys.readouterr().out


def test_removing_is_the_complement(folder):
    for words in ((), ("--remove",)):
        assert run("select", "a.ply", "book", "--out", f"{len(words)}.ply", *words) == 0
    with_it, without = (labels(load_scene(f"{k}.ply")) for k in (0, 1))
    assert sorted([*with_it, *without]) == list(range(3 * PER_BLOB))
    assert not QueryEngine(load_scene("1.ply")).run("book").found


@pytest.mark.parametrize(
    ("how", "want"), [("union", [1, 1, 0]), ("intersection", [1, 0, 0]), ("difference", [0, 0, 1])]
)
def test_several_phrases(folder, how, want):
    phrases = {"union": ("mug", "book"), "intersection": ("mug", "pair"), "difference": ("pair", "mug")}[how]
    assert run("select", "a.ply", *phrases, "--combine", how, "--out", "b.ply") == 0
    assert [count > 0.8 * PER_BLOB for count in blob_of(load_scene("b.ply"))] == [bool(k) for k in want]


def test_one_of_several_things(folder, capsys):
    assert run("select", "a.ply", "pair", "--out", "all.ply", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert [thing["number"] for thing in answer["instances"]] == answer["taken"] == [1, 2]
    assert answer["written"] == answer["selected"] == len(load_scene("all.ply").gaussians)
    assert answer["metres_per_unit"] == 0.5
    assert run("select", "a.ply", "pair", "--out", "one.ply", "--instance", "2") == 0
    second = load_scene("one.ply")
    assert len(second.gaussians) == answer["instances"][1]["gaussians"]
    centre = second.gaussians.means.mean(0)
    np.testing.assert_allclose(centre, answer["instances"][1]["centre"], atol=0.05)


def test_growing_and_shrinking_are_in_metres(folder):
    sizes = {}
    for name, words in {"0": (), "g": ("--grow", "0.2"), "s": ("--shrink", "0.01")}.items():
        assert run("select", "a.ply", "book", "--out", f"{name}.ply", *words) == 0
        sizes[name] = len(load_scene(f"{name}.ply").gaussians)
    assert sizes["s"] <= sizes["0"] < sizes["g"]
    assert run("select", "a.ply", "book", "--out", "u.ply", "--grow", "0.4", "--scale", "1") == 0
    assert len(load_scene("u.ply").gaussians) == sizes["g"]


def test_points_and_hulls(folder, capsys):
    assert run("select", "a.ply", "mug", "--out", "p.ply", "--as", "points") == 0
    vertex = PlyData.read("p.ply")["vertex"]
    assert 0.9 * PER_BLOB < len(vertex["x"]) <= PER_BLOB
    assert vertex["relevancy"].min() > 0.5
    assert vertex["red"].mean() > 190 > 60 > vertex["green"].mean() > 40
    assert run("select", "a.ply", "pair", "--out", "h.obj", "--as", "hull") == 0
    assert "h.obj: 2 closed hulls" in capsys.readouterr().out
    assert [line for line in Path("h.obj").read_text().splitlines() if line[0] == "o"] == [
        "o pair_1",
        "o pair_2",
    ]
    assert run("select", "a.ply", "mug", "--out", "rest.ply", "--as", "points", "--remove") == 0
    assert len(PlyData.read("rest.ply")["vertex"]["x"]) >= 2 * PER_BLOB


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("void",), "'void' was not found"),
        (("mug", "void"), "'void' was not found"),
        (("spoon",), "does not know 'spoon'"),
        (("",), "empty"),
        ((), "no phrase given"),
        (("mug", "book", "--combine", "intersection"), "the intersection of 'mug', 'book' is empty"),
        (("mug", "--instance", "2"), "--instance 2: there are 1, numbered from 1"),
        (("mug", "--instance", "0"), "--instance 0"),
        (("mug", "--grow", "-1"), "--grow -1: must be 0 to 1e+09"),
        (("mug", "--shrink", "nan"), "--shrink nan"),
        (("pair", "--shrink", "9"), "nothing is left; shrink by less"),
        (("mug", "book", "plant", "--grow", "99", "--remove"), "the whole scene"),
        (("mug", "--as", "hull", "--remove"), "--as hull"),
        (("mug", "--as", "hull", "--out", "b.stl"), ".ply or .obj"),
        (("mug", "--as", "points", "--out", "b.spz"), "written as .ply"),
        (("mug", "--out", "b.sog"), "scenes are written as"),
        (("mug", "--out", "a.ply"), "would replace the original"),
        (("mug", "--out", "there/b.ply"), "there: no such folder for b.ply"),
        (("mug", "--scale", "0"), "--scale 0"),
    ],
)
def test_what_cannot_be_selected_is_said_in_a_line_and_nothing_is_written(folder, capsys, words, message):
    before = sorted(path.name for path in folder.iterdir())
    out = () if "--out" in words else ("--out", "b.ply")
    assert run("select", "a.ply", *words, *out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert sorted(path.name for path in folder.iterdir()) == before


def test_a_scene_without_a_field_cannot_be_asked(folder, capsys):
    save_scene("plain.ply", blob_scene(field=False))
    assert run("select", "plain.ply", "mug", "--out", "b.ply") == 2
    assert "no language field" in capsys.readouterr().err


def test_a_known_length_gives_the_scale(folder, capsys):
    assert run("scale", "a.ply", "--metres", "0.3", "--between", "-1", "0", "0", "0.2", "0", "0") == 0
    assert load_scene("a.ply").metres_per_unit == pytest.approx(0.25)
    assert "0.25 m per unit" in capsys.readouterr().out
    assert run("scale", "a.ply", "--metres-per-unit", "2") == 0
    assert run("scale", "a.ply") == 0
    assert capsys.readouterr().out.count("2 m per unit") == 2
    save_scene("plain.ply", blob_scene())
    assert run("scale", "plain.ply") == 0
    assert "no scale" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"metres": 1.0}, "belong together"),
        ({"between": (0, 0, 0, 1, 0, 0)}, "belong together"),
        ({"metres": 1.0, "between": (0, 0, 0, 0, 0, 0)}, "both must be above 0"),
        ({"metres": -1.0, "between": (0, 0, 0, 1, 0, 0)}, "both must be above 0"),
        ({"metres": 1.0, "between": (0, 0, 0, 1, 0, 0), "metres_per_unit": 1.0}, "give either"),
        ({"metres_per_unit": 0.0}, "must be above 0"),
    ],
)
def test_a_scale_that_is_none(folder, given, message):
    with pytest.raises(InputError, match=message):
        Scale(folder / "a.ply", **given).run()
    assert load_scene("a.ply").metres_per_unit == 0.5


# `langsplat describe`.

@pytest.fixture
def described(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene, the same without field or cameras, and lists of phrases."""
    scene = named_scene()
    save_scene(tmp_path / "a.ply", scene)
    save_scene(tmp_path / "plain.ply", Scene(scene.gaussians))
    save_scene(tmp_path / "blind.ply", replace(scene, cameras=()))
    (tmp_path / "list.txt").write_text("\n".join([*NAMES, "sofa"]))
    (tmp_path / "empty.txt").write_text("# nothing\n")
    (tmp_path / "bad.txt").write_text("mug\n???\n")
    (tmp_path / "sofas.txt").write_text("sofa\n")
    monkeypatch.setattr("langsplat_core.cli.query.load_text_encoder", lambda _: FakeEncoder())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def describe(*words: str) -> int:
    return main("langsplat", lambda: parse(["describe", *words]))


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("a.ply", "--camera", "3", "--pixel", "1", "1"), "--camera 3: the scene has cameras 0 to 2"),
        (("a.ply", "--pixel", "160", "1"), "--pixel 160 1: camera 0 has columns 0 to 159 and rows 0 to 119"),
        (("a.ply", "--pixel", "-1", "1"), "--pixel -1 1"),
        (("a.ply", "--gaussian", "360"), "--gaussian 360: the scene has Gaussians 0 to 359"),
        (("a.ply", "--gaussian", "1", "--pixel", "1", "1"), "ask one of them"),
        (("a.ply", "--phrase", "mug", "--pixel", "1", "1"), "ask one of them"),
        (("a.ply", "--instance", "2"), "--instance 2 needs a --phrase"),
        (("a.ply", "--phrase", "mug", "--instance", "9"), "--instance 9: there are 1"),
        (("a.ply", "--phrase", "wall"), "'wall' was not found"),
        (("a.ply", "--camera", "1"), "needs a --pixel X Y"),
        (("a.ply", "--top", "0"), "--top 0"),
        (("a.ply", "--vocabulary", "empty.txt"), "empty.txt: the vocabulary is empty"),
        (("a.ply", "--vocabulary", "bad.txt"), "bad.txt, line 2"),
        (("a.ply", "--vocabulary", "sofas.txt"), "knows none of the vocabulary's 1 phrases"),
        (("a.ply", "--vocabulary", "none.txt"), "none.txt: the vocabulary cannot be read"),
        (("plain.ply",), "no language field"),
        (("blind.ply", "--pixel", "1", "1"), "has no cameras"),
        (("nowhere.ply",), "nowhere.ply"),
        (("a.ply", "--level", "thing"), "level"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(folder, capsys, words, problem):
    assert describe(*words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    lines = [line for line in said.err.splitlines() if line.startswith("langsplat:")]
    assert len(lines) == 1
    assert problem in lines[0]


def test_the_inventory_as_a_table_and_what_was_left_out(folder, capsys):
    assert describe("a.ply", "--vocabulary", "list.txt") == 0
    said = capsys.readouterr().out
    for word in ("mug", "book", "plant"):
        assert word in said
    assert "wall" not in said
    assert "4 phrases were compared; 1 were left out" in said
    assert "sofa" in said


def test_the_inventory_as_json(folder, capsys):
    assert describe("a.ply", "--vocabulary", "list.txt", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["asked"], found["left_out"]) == (4, 1)
    assert {entry["phrase"] for entry in found["inventory"]} == {"mug", "book", "plant"}
    for entry in found["inventory"]:
        assert entry["level"] == "whole"
        assert 0 < entry["softmax"] <= 1
        assert entry["probability"] is None
        assert all(len(spot["centre"]) == 3 for spot in entry["spots"])
    assert describe("a.ply", "--vocabulary", "list.txt", "--json", "--level", "subpart") == 0
    assert json.loads(capsys.readouterr().out)["inventory"] == []


def test_a_gaussian_and_a_pixel(folder, capsys):
    assert describe("a.ply", "--gaussian", "0", "--vocabulary", "list.txt", "--level", "whole", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["gaussian"] == 0
    (level,) = found["levels"]
    assert level["words"][0]["phrase"] == "mug"
    assert level["known"] == 1
    camera = named_scene().cameras[1]
    (column, row), _ = camera.project(named_scene().gaussians.means[:1])[0].astype(int)[0], None
    place = ("--camera", "1", "--pixel", str(column), str(row))
    assert describe("a.ply", *place, "--vocabulary", "list.txt", "--top", "2") == 0
    said = capsys.readouterr().out
    assert "whole    mug" in said
    assert "%" not in said
    assert "subpart  nothing is known here" in said
    assert describe("a.ply", "--pixel", "0", "0", "--vocabulary", "list.txt") == 0
    assert capsys.readouterr().out.count("nothing is known here") == 3


def test_a_thing_that_a_phrase_finds(folder, capsys):
    assert describe("a.ply", "--phrase", "book", "--vocabulary", "list.txt", "--level", "whole", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["phrase"] == "book"
    assert found["thing"]["gaussians"] > 50
    (level,) = found["levels"]
    assert level["words"][0]["phrase"] == "book"
