"""A scene whose companions are broken opens without them, and says why."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from langsplat_core.cli.query import QueryScene
from langsplat_core.cli.scenes import Inspect
from langsplat_core.errors import InputError
from langsplat_core.io import load_scene, load_without_language, save_scene
from langsplat_core.query.engine import NO_FIELD, QueryEngine
from tests.support.fakes import blob_scene

CAMERAS, FIELD = "a.cameras.json", "a.langsplat.safetensors"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A scene with a field and cameras."""
    path = tmp_path / "a.ply"
    save_scene(path, replace(blob_scene(phrasebook=True), path=None))
    return path


def spoil(path: Path, name: str) -> None:
    companion = path.with_name(name)
    companion.write_bytes(companion.read_bytes()[:50])


def test_cameras_that_cannot_be_read(path, caplog):
    spoil(path, CAMERAS)
    scene = load_scene(path)
    assert (scene.cameras, len(scene.gaussians)) == ((), 360)
    assert scene.language is not None
    (reason,) = scene.unread
    assert CAMERAS in reason
    assert "\n" not in reason
    assert reason in caplog.text
    assert load_without_language(path).unread == scene.unread
    assert QueryEngine(scene).run("book").found


@pytest.mark.parametrize("other", [False, True])
def test_a_field_that_cannot_be_read_or_is_of_another_scene(path, capsys, other):
    if other:
        scene = load_scene(path)
        save_scene(path.with_name("b.ply"), scene.take([1, 0, 2]))
        path.with_name("b.langsplat.safetensors").replace(path.with_name(FIELD))
    else:
        spoil(path, FIELD)
    scene = load_scene(path)
    assert scene.language is None
    assert len(scene.cameras) == 3
    (reason,) = scene.unread
    assert FIELD in reason
    for ask in (lambda: QueryEngine(scene).run("book"), QueryScene(path, ("book",)).run):
        with pytest.raises(InputError, match="looked at, not searched") as refused:
            ask()
        assert reason in str(refused.value)
    Inspect(path, json=True).run()
    assert json.loads(capsys.readouterr().out)["unread"] == [reason]
    Inspect(path).run()
    assert "not read" in capsys.readouterr().out


def test_a_scene_without_a_field_says_how_to_make_one(tmp_path):
    save_scene(tmp_path / "a.ply", blob_scene(field=False))
    scene = load_scene(tmp_path / "a.ply")
    assert scene.unread == ()
    with pytest.raises(InputError) as refused:
        QueryEngine(scene).run("book")
    assert str(refused.value) == NO_FIELD


@pytest.mark.parametrize("name", [CAMERAS, FIELD])
def test_what_could_not_be_read_is_not_removed_by_writing(path, name):
    spoil(path, name)
    before = path.with_name(name).read_bytes()
    with pytest.raises(InputError, match="mend or remove it first"):
        save_scene(path, load_scene(path))
    assert path.with_name(name).read_bytes() == before
