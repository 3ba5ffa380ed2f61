"""The outline: the tree in words, and what is done with its rows."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_viewer.actions import editing, opening, outline, saving, settings
from langsplat_viewer.actions.editing import take
from langsplat_viewer.session import Things
from tests.support.fakes import CENTRES, blob_scene
from tests.support.scenes import with_tree
from tests.support.windowless import SCENES, act, ask, blob, errors, marked, open_scene, result, settle


@pytest.fixture
def outlined(viewer, monkeypatch):
    """The blobs with a tree, its outline found."""
    monkeypatch.setitem(SCENES, "tree.ply", with_tree(blob_scene(phrasebook=True)))
    open_scene(viewer, "tree.ply")
    ask(viewer, "mug")  # so that the encoder is known to be there
    assert outline.wanted(viewer).problem
    settle(viewer)
    assert outline.wanted(viewer).problem == ""
    return viewer


def row_of(viewer, word: str):
    """The row of most of a blob."""
    tree = viewer.state.outline.tree
    return max(viewer.state.outline.roots, key=lambda row: (tree.members(row.node) & blob(word)).sum())


@pytest.fixture
def nodes(outlined) -> list[int]:
    """Of mug, book and plant."""
    return [row_of(outlined, word).node for word in ("mug", "book", "plant")]


def test_outline_row_is_named_and_selects_its_thing(outlined):
    before = outlined.state.view
    for word, centre in zip(("mug", "book", "plant"), CENTRES, strict=True):
        row = row_of(outlined, word)
        assert word in outline.name_of(outlined, row)
        assert (outlined.engine.tree.members(row.node) == blob(word)).all()
        assert outlined.state.outline.row(row.node) is row
        act(outline.visit, outlined, row.node)
        assert marked(outlined)[0] == word
        assert outlined.state.glide.end.distance < before.distance
        np.testing.assert_allclose(outlined.state.glide.end.target, centre, atol=0.2)
    assert sum(row.count for row in outlined.state.outline.roots) == 360


def test_clicked_thing_is_selected(outlined):
    for choose, centre, word in (
        (outline.select, CENTRES[2], "plant"),
        (outline.find_alike, CENTRES[0], "mug"),
    ):
        act(choose, outlined, centre)
        assert marked(outlined)[0] == word


def test_hidden_row_keeps_the_selection(outlined, nodes):
    mug, book, _ = nodes
    take(outlined, blob("plant"))
    act(outline.hide, outlined, mug)
    assert marked(outlined) == ("plant", "mug", "")
    hidden = outline.hidden_nodes(outlined)
    assert (hidden[mug], hidden[book]) == (True, False)
    assert outline.hidden_nodes(outlined) is hidden
    act(outline.show, outlined, mug)
    assert marked(outlined) == ("plant", "", "")
    editing.undo(outlined)
    assert outline.hidden_nodes(outlined)[mug]


def test_given_name_is_taught_and_filtered(outlined):
    mug = row_of(outlined, "mug")
    act(outline.give_name, outlined, mug.node, "  grandma's cup ")
    assert outline.name_of(outlined, mug) == "grandma's cup"
    assert outlined.state.session.queries[-1].phrase == "grandma's cup"
    assert result(outlined, -1).found
    rows = list(outline.filtered(outlined, outlined.state.outline.roots, "CUP grand"))
    assert [row.node for row in rows] == [mug.node]
    assert list(outline.filtered(outlined, outlined.state.outline.roots, "zebra")) == []
    book = row_of(outlined, "book").node
    act(outline.give_name, outlined, book, "the atlas")
    assert outlined.engine.taught.keys() == {"grandma's cup", "the atlas"}
    act(outline.give_name, outlined, book, "of")  # which names nothing
    assert outlined.state.session.things.names[book] == "the atlas"
    outlined.state.messages.clear()
    outline.give_name(outlined, mug.node, " ")
    assert errors(outlined) == []


@pytest.mark.parametrize("field", [True, False])
def test_project_keeps_names_of_known_nodes(outlined, nodes, tmp_path, monkeypatch, field):
    """As after training anew, or for a scene whose field is gone."""
    monkeypatch.chdir(tmp_path)
    Path("tree.ply").touch()
    act(outline.give_name, outlined, nodes[1], "the atlas")
    things, path = outlined.state.session.things, saving.save_project(outlined, tmp_path)
    open_scene(outlined, "plain.ply")
    assert outlined.state.session.things != things
    act(opening.open_project, outlined, path)
    assert outlined.state.session.things == things
    top = json.loads(path.read_text())
    top["session"]["things"]["names"][10**9] = "ghost"
    path.write_text(json.dumps(top))
    if not field:
        monkeypatch.setitem(SCENES, "tree.ply", replace(SCENES["tree.ply"], language=None))
    act(opening.open_project, outlined, path)
    assert outlined.state.session.things == (things if field else Things())


def test_scene_of_other_gaussians_drops_names(outlined, monkeypatch):
    outlined.put(things=Things({0: "cup"}))
    monkeypatch.setitem(SCENES, "tree.ply", with_tree(SCENES["tree.ply"].take(np.arange(300))))
    act(opening.reload, outlined)
    assert outlined.state.session.things == Things()


def test_things_have_the_colour_of_the_image(outlined, nodes):
    settings.set_display(outlined, "rgb")
    mug, book, _ = nodes
    assert outline.colour_of(outlined, mug) is None
    for display in ("latent", "tree"):
        settings.set_display(outlined, display, 2)
        one, other = outline.colour_of(outlined, mug), outline.colour_of(outlined, book)
        assert np.abs(np.subtract(one, other)).max() > 0.05
    named = [outline.name_of(outlined, row) for row in outline.in_view(outlined)]
    assert {"mug", "book", "plant"} <= {word for name in named for word in name.split()}


def test_outline_needs_a_field_and_downloads_no_encoder(viewer, monkeypatch):
    scene = SCENES["blobs.ply"]
    far = replace(scene, language=replace(scene.language, encoder_id="hub/of-someone"))
    monkeypatch.setitem(SCENES, "blobs.ply", far)
    open_scene(viewer, "blobs.ply")
    assert "hub/of-someone" in outline.wanted(viewer).problem
    assert viewer.worker.current is None
    open_scene(viewer, "plain.ply")
    assert outline.wanted(viewer) is None
    outline.select(viewer, np.zeros(3))
    assert "language field" in errors(viewer)[-1]
