"""`langsplat find` and `langsplat changes`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.extensions.library import commands as find
from langsplat_core.io.scenes import save_scene
from tests.support.commands import refusal, run
from tests.support.fakes import (
    PER_BLOB,
    FakeEncoder,
    named_scene,
)


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder; in "scans" a scene with mug, book and plant, and one without the mug."""
    (tmp_path / "scans" / "<b>&").mkdir(parents=True)
    save_scene(tmp_path / "scans" / "whole.ply", named_scene())
    fewer = named_scene().take(np.arange(PER_BLOB, 3 * PER_BLOB))
    save_scene(tmp_path / "scans" / "<b>&" / "fewer.ply", fewer)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(find, "load_text_encoder", lambda name: FakeEncoder())
    return tmp_path


def test_find_lists_the_scenes_that_have_it(scans, capsys):
    assert run("find", "mug", "book", "scans", "--json") == 0
    mug, book = json.loads(capsys.readouterr().out)
    assert (mug["phrase"], mug["found"], mug["not_here"]) == ("mug", 1, 1)
    assert [scene["scene"] for scene in mug["scenes"]] == ["whole.ply"]
    np.testing.assert_allclose(mug["scenes"][0]["place"], (-1.2, 0, 0), atol=0.2)
    assert book["found"] == 2
    assert run("find", "mug", "scans", "--all") == 0
    text = capsys.readouterr().out
    assert "found in 1 of 2 scenes" in text
    assert "fewer.ply: not here" in text


def test_sheets_show_every_answer_and_escape_names(scans):
    assert run("find", "book", "scans", "--sheet", "sheet.html") == 0
    text = (scans / "sheet.html").read_text()
    assert text.count("<img") == 2
    assert "&lt;b&gt;&amp;/fewer.ply" in text
    assert "<b>" not in text
    assert run("find", "book", "scans", "--sheet", "sheet.png") == 0
    picture = np.asarray(Image.open(scans / "sheet.png"))
    assert picture.shape[1] > 4 * 320
    assert np.ptp(picture[60:200, 20:600].astype(int)) > 100


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["mug"], "phrases and a folder"),
        (["mug", "elsewhere"], "no such folder"),
        (["mug", "scans", "--sheet", "sheet.txt"], ".html"),
        (["the", "scans"], "the"),
    ],
)
def test_find_says_what_is_wrong_in_a_line(scans, capsys, words, said):
    assert said in refusal(capsys, "find", *words)
    assert not (scans / "sheet.txt").exists()


def test_changes_are_said_in_words_and_in_json(scans, capsys):
    pair = "scans/whole.ply", "scans/<b>&/fewer.ply"
    assert run("changes", *pair) == 0
    assert capsys.readouterr().out.startswith("gone: ")
    assert run("changes", pair[0], pair[0]) == 0
    assert capsys.readouterr().out.strip() == "nothing changed"
    scene = named_scene()
    sh = scene.gaussians.sh.copy()
    sh[:PER_BLOB] = sh[2 * PER_BLOB :]
    save_scene(scans / "painted.ply", replace(scene, gaussians=replace(scene.gaussians, sh=sh)))
    assert run("changes", pair[0], "painted.ply") == 0
    assert "red to blue" in capsys.readouterr().out
    (scans / "placed.json").write_text(json.dumps({"matrix": np.eye(4).tolist()}))
    assert run("changes", pair[0], "painted.ply", "--transform", "placed.json", "--json") == 0
    (change,) = json.loads(capsys.readouterr().out)["changes"]
    assert (change["kind"], change["colours"]) == ("recoloured", ["red", "blue"])
    both = "--transform", "placed.json", "--register"
    assert "leave one of them out" in refusal(capsys, "changes", pair[0], "painted.ply", *both)


@pytest.mark.parametrize(
    "text", ["[[1]]", "{}", "[[1, 2], [3]]", '"x"', "[" * 50, '{"matrix": [[0,0,0,0]]}', '{"matrix": 3}']
)
def test_a_transform_that_is_none_is_refused(scans, capsys, text):
    (scans / "placed.json").write_text(text)
    words = "scans/whole.ply", "scans/whole.ply", "--transform", "placed.json"
    assert "placed.json" in refusal(capsys, "changes", *words)
