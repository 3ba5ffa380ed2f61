"""`langsplat query`."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from langsplat_core.cli import query
from langsplat_core.cli.query import QueryScene
from langsplat_core.config import INRIA
from langsplat_core.errors import EncoderError, InputError, LangSplatError
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_rasterizer
from langsplat_core.scene import Reading, Scene
from langsplat_core.semantics.encoder import OPEN_MODEL
from tests.benchmarks.scoring import ask, evaluate
from tests.support.fakes import FakeEncoder, axis, blobs, calibrated_for
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
