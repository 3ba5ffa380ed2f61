"""`langsplat teach`, and `query` for what was taught and for more like this."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.cli import query
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.io.sidecar import read_words
from langsplat_core.scene import Scene
from tests.support.comparing import assert_same_field
from tests.support.fakes import PER_BLOB, axis, language, named_scene
from tests.support.processes import refusal, run

SCENE = named_scene()


def pixel_of(blob: int) -> str:
    """The pixel of the first camera in the middle of a blob, as the options have it."""
    means = SCENE.gaussians.means[blob * PER_BLOB : (blob + 1) * PER_BLOB].astype(np.float64)
    column, row = SCENE.cameras[0].project(means.mean(0)[None])[0][0].astype(int)
    return f"{column},{row}"


NO_PIXELS = ("80", "a,b", "-1,2", "1,2,3", "1.5,2", "9" * 5000 + ",1", "٣,٣")
MUG, BOOK = pixel_of(0), pixel_of(1)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: a scene "a.ply", the same again, one of another encoder, and without cameras. There
    is no encoder."""
    for name in ("a.ply", "b.ply"):
        save_scene(tmp_path / name, SCENE)
    other = replace(SCENE.language, encoder_id="other", canonical=np.tile(axis(5), (4, 1)))
    save_scene(tmp_path / "other.ply", replace(SCENE, language=other))
    save_scene(tmp_path / "blind.ply", replace(SCENE, cameras=()))
    save_scene(tmp_path / "plain.ply", Scene(SCENE.gaussians))
    (tmp_path / "junk.safetensors").write_bytes(b"junk")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def asked(capsys, *words: str):
    """The answers of `langsplat query`."""
    capsys.readouterr()
    assert run("query", *words, "--json") == 0
    return json.loads(capsys.readouterr().out)


def test_scene_keeps_and_forgets_taught_words(folder, capsys):
    before = load_scene("a.ply").language
    teach = ("teach", "a.ply", "--name", "grandma's vase")
    assert run(*teach, "--at", MUG) == 0
    said = capsys.readouterr().out
    assert f"{PER_BLOB} Gaussians, shown once" in said
    assert "a.langsplat.safetensors: taught words: 1" in said
    (answer,) = asked(capsys, "a.ply", "Grandma's vase")
    assert (answer["verdict"], answer["probability"], answer["level"]) == ("found", None, "whole")
    assert [one["gaussians"] for one in answer["instances"]] == [PER_BLOB]
    assert answer["pixel"] == pytest.approx([int(number) for number in MUG.split(",")], abs=12)
    assert run(*teach, "--at", BOOK) == 0
    assert "shown 2 times" in capsys.readouterr().out
    (both,) = asked(capsys, "a.ply", "grandma's vase")
    assert sum(one["gaussians"] for one in both["instances"]) == 2 * PER_BLOB
    assert run("select", "a.ply", "grandma's vase", "--out", "c.ply") == 0
    assert len(load_scene("c.ply").gaussians) == 2 * PER_BLOB
    assert run(*teach, "--remove") == 0
    assert_same_field(load_scene("a.ply").language, before)


def test_users_words_work_in_other_scenes(folder, capsys):
    teach = ("--into", "words.safetensors", "--camera", "0")
    untouched = Path("a.langsplat.safetensors").read_bytes()
    assert run("teach", "a.ply", "--name", "book", "--at", MUG, *teach) == 0
    assert run("teach", "a.ply", "--name", "wall", "--at", BOOK, "--level", "whole", *teach) == 0
    assert Path("a.langsplat.safetensors").read_bytes() == untouched
    assert [word.name for word in read_words("words.safetensors").words] == ["book", "wall"]
    book, mug = asked(capsys, "b.ply", "book", "mug", "--taught", "words.safetensors")
    assert book["place"] == pytest.approx(mug["place"], abs=0.1)  # what was shown, in place of the text
    (plain,) = asked(capsys, "b.ply", "book")
    assert plain["place"] != pytest.approx(book["place"], abs=0.1)
    assert run("teach", "a.ply", "--name", "Book", "--remove", *teach) == 0
    assert [word.name for word in read_words("words.safetensors").words] == ["wall"]
    assert run("select", "b.ply", "wall", "--out", "c.ply", "--taught", "words.safetensors") == 0
    assert len(load_scene("c.ply").gaussians) == PER_BLOB


def test_like_option_stands_beside_phrases_or_alone(folder, capsys):
    (alone,) = asked(capsys, "a.ply", "--like", BOOK)
    assert (alone["phrase"], alone["found"]) == (f"like {BOOK}", True)
    assert alone["instances"][0]["gaussians"] == PER_BLOB
    assert [one["phrase"] for one in asked(capsys, "a.ply", "mug", "--like", BOOK)] == ["mug", f"like {BOOK}"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (f"teach a.ply --name the --at {MUG}", "'the' cannot be a name"),
        (f"teach a.ply --name ?! --at {MUG}", "'' cannot be a name"),
        (f"teach a.ply --name a;b --at {MUG}", "without commas and semicolons"),
        ("teach a.ply --name vase", "give either --at X,Y, a pixel to teach, or --remove"),
        (f"teach a.ply --name vase --at {MUG} --remove", "either --at"),
        ("teach a.ply --name vase --at 0,0", "--at 0,0: nothing is there in camera 0"),
        ("teach a.ply --name vase --at 160,0", "--at 160,0: camera 0 has columns 0 to 159 and rows 0 to 119"),
        ("teach a.ply --name vase --at 80,60 --camera 7", "--camera 7: the scene has cameras 0 to 2"),
        *((f"teach a.ply --name vase --at={at}", "give column and row") for at in NO_PIXELS),
        (f"teach a.ply --name vase --at {MUG} --level subpart", "point at something else"),
        ("teach a.ply --name vase --remove", "'vase' was not taught here; taught words: none"),
        (f"teach blind.ply --name vase --at {MUG}", "no cameras"),
        (f"teach plain.ply --name vase --at {MUG}", "no language field"),
        (f"teach a.ply --name vase --at {MUG} --into words.json", "written as .safetensors"),
        (f"teach a.ply --name vase --at {MUG} --into junk.safetensors", "not a whole safetensors file"),
        (f"teach a.ply --name vase --at {MUG} --into a.langsplat.safetensors", "not of taught words"),
        (f"teach other.ply --name vase --at {MUG} --into own.safetensors", "own.safetensors: these words"),
        ("query other.ply mug --taught own.safetensors", "with fake, the scene was made with other"),
        ("query a.ply mug --taught none.safetensors", "no such file"),
        ("query a.ply vase --mode paper --taught own.safetensors", "--mode paper"),
        (f"query a.ply mug --mode paper --like {MUG}", "--mode paper"),
        ("query a.ply --like 0,0", "--like 0,0: nothing is there"),
        ("query a.ply --like here", "give column and row"),
        ("query blind.ply --like 1,1", "no cameras"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_nothing_is_written(folder, capsys, monkeypatch, words, message):
    monkeypatch.setattr(query, "load_text_encoder", None)
    assert run("teach", "a.ply", "--name", "vase", "--at", MUG, "--into", "own.safetensors") == 0
    capsys.readouterr()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert message in refusal(capsys, *words.split())
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_taught_word_may_be_a_part(folder, capsys):
    field = language()
    field.latents[1] = field.latents[2]
    save_scene("parts.ply", Scene(SCENE.gaussians, field, SCENE.cameras))
    assert run("teach", "parts.ply", "--name", "knob", "--at", MUG, "--level", "part") == 0
    (answer,) = asked(capsys, "parts.ply", "knob")
    assert (answer["level"], answer["found"]) == ("part", True)
