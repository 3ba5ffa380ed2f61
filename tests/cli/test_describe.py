"""`langsplat describe`."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.blob_words import NAMES, named_scene
from tests.support.fakes import FakeEncoder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
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


def run(*words: str) -> int:
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
    assert run(*words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    lines = [line for line in said.err.splitlines() if line.startswith("langsplat:")]
    assert len(lines) == 1
    assert problem in lines[0]


def test_the_inventory_as_a_table_and_what_was_left_out(folder, capsys):
    assert run("a.ply", "--vocabulary", "list.txt") == 0
    said = capsys.readouterr().out
    for word in ("mug", "book", "plant"):
        assert word in said
    assert "wall" not in said
    assert "4 phrases were compared; 1 were left out" in said
    assert "sofa" in said


def test_the_inventory_as_json(folder, capsys):
    assert run("a.ply", "--vocabulary", "list.txt", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["asked"], found["left_out"]) == (4, 1)
    assert {entry["phrase"] for entry in found["inventory"]} == {"mug", "book", "plant"}
    for entry in found["inventory"]:
        assert entry["level"] == "whole"
        assert 0 < entry["softmax"] <= 1
        assert entry["probability"] is None
        assert all(len(spot["centre"]) == 3 for spot in entry["spots"])
    assert run("a.ply", "--vocabulary", "list.txt", "--json", "--level", "subpart") == 0
    assert json.loads(capsys.readouterr().out)["inventory"] == []


def test_a_gaussian_and_a_pixel(folder, capsys):
    assert run("a.ply", "--gaussian", "0", "--vocabulary", "list.txt", "--level", "whole", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["gaussian"] == 0
    (level,) = found["levels"]
    assert level["words"][0]["phrase"] == "mug"
    assert level["known"] == 1
    camera = named_scene().cameras[1]
    (column, row), _ = camera.project(named_scene().gaussians.means[:1])[0].astype(int)[0], None
    place = ("--camera", "1", "--pixel", str(column), str(row))
    assert run("a.ply", *place, "--vocabulary", "list.txt", "--top", "2") == 0
    said = capsys.readouterr().out
    assert "whole    mug" in said
    assert "%" not in said
    assert "subpart  nothing is known here" in said
    assert run("a.ply", "--pixel", "0", "0", "--vocabulary", "list.txt") == 0
    assert capsys.readouterr().out.count("nothing is known here") == 3


def test_a_thing_that_a_phrase_finds(folder, capsys):
    assert run("a.ply", "--phrase", "book", "--vocabulary", "list.txt", "--level", "whole", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["phrase"] == "book"
    assert found["thing"]["gaussians"] > 50
    (level,) = found["levels"]
    assert level["words"][0]["phrase"] == "book"
