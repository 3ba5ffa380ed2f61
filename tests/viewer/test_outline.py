"""The outline: the tree in words, what is done with its rows, and what stays locked."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_viewer.actions import browsing, editing, opening, outline, projects, selecting, settings
from langsplat_viewer.actions.selecting import take
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


def test_locked_thing_is_left_alone(outlined, nodes):
    mug = nodes[0]
    take(outlined, blob("mug") | blob("book"))
    outline.toggle_lock(outlined, mug)
    assert marked(outlined)[0] == "book"
    selecting.select_all(outlined)
    assert marked(outlined)[0] == "book plant"
    take(outlined, blob("book"))
    selecting.isolate_selected(outlined)
    assert marked(outlined)[1] == "plant"
    selecting.show_hidden(outlined)
    act(outline.hide, outlined, mug)
    assert marked(outlined)[1] == ""
    editing.fill_box(outlined)
    editing.crop(outlined)
    assert "mug" not in marked(outlined)[2]
    editing.undo(outlined)
    outline.toggle_lock(outlined, mug)
    selecting.select_all(outlined)
    assert marked(outlined)[0] == "mug book plant"


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
    outline.toggle_lock(outlined, book)
    act(outline.give_name, outlined, book, "the atlas")  # also of what no tool takes
    assert outlined.engine.taught.keys() == {"grandma's cup", "the atlas"}
    act(outline.give_name, outlined, book, "of")  # which names nothing
    assert outlined.state.session.things.names[book] == "the atlas"
    outlined.state.messages.clear()
    outline.give_name(outlined, mug.node, " ")
    assert errors(outlined) == []


def test_groups_are_made_renamed_and_dissolved(outlined, nodes):
    mug, book, plant = nodes
    outline.group(outlined, mug, book)
    (group,) = outlined.state.session.things.groups
    assert group.nodes == (book, mug)
    outline.group(outlined, plant, group)
    outline.rename_group(outlined, outlined.state.session.things.groups[0], "on the table")
    (group,) = outlined.state.session.things.groups
    assert (group.name, group.nodes) == ("on the table", (book, mug, plant))
    other = replace(group, name="other", nodes=(plant,))
    outlined.put(things=Things(groups=(group, other)))
    outline.rename_group(outlined, other, "on the table")
    assert "already" in errors(outlined)[-1]
    outlined.put(things=Things(groups=(group,)))
    outline.select_group(outlined, group)
    assert marked(outlined)[0] == "mug book plant"
    outline.ungroup(outlined, mug)
    assert outlined.state.session.things.groups[0].nodes == (book, plant)
    editing.undo(outlined)
    assert outlined.state.session.things.groups[0].nodes == (book, mug, plant)
    for node in (mug, book, plant):
        outline.ungroup(outlined, node)
    assert outlined.state.session.things.groups == ()
    outline.group(outlined, mug, None)
    outline.group(outlined, mug, None)  # out of the first, which is then empty
    assert [group.nodes for group in outlined.state.session.things.groups] == [(mug,)]
    outline.ungroup(outlined, mug)
    outline.group(outlined, mug, mug)
    assert outlined.state.session.things.groups == ()


@pytest.mark.parametrize("field", [True, False])
def test_project_keeps_names_groups_and_locks_of_known_nodes(outlined, nodes, tmp_path, monkeypatch, field):
    """As after training anew, or for a scene whose field is gone."""
    monkeypatch.chdir(tmp_path)
    Path("tree.ply").touch()
    mug, book, _ = nodes
    outline.group(outlined, mug, book)
    outline.toggle_lock(outlined, mug)
    act(outline.give_name, outlined, book, "the atlas")
    things, path = outlined.state.session.things, projects.save_project(outlined, tmp_path)
    open_scene(outlined, "plain.ply")
    assert outlined.state.session.things != things
    act(browsing.open_project, outlined, path)
    assert outlined.state.session.things == things
    selecting.select_all(outlined)
    assert marked(outlined)[0] == "book plant"
    top = json.loads(path.read_text())
    odd = [mug, 10**9, 10**9, mug]
    groups = [{"name": "a", "nodes": odd}, {"name": "b", "nodes": [10**9]}]
    names = {10**9: "ghost", mug: "cup"}
    top["session"]["things"] = {"names": names, "groups": groups, "locked": odd}
    path.write_text(json.dumps(top))
    if not field:
        monkeypatch.setitem(SCENES, "tree.ply", replace(SCENES["tree.ply"], language=None))
    act(browsing.open_project, outlined, path)
    things = outlined.state.session.things
    selecting.select_all(outlined)
    if field:
        assert (things.names, things.locked, things.groups[0].nodes) == ({mug: "cup"}, {mug}, (mug,))
        assert marked(outlined)[0] == "book plant"
        outline.select_group(outlined, things.groups[0])
    else:
        assert things == Things()
        assert marked(outlined)[0] == "mug book plant"


def test_retrained_scene_drops_unknown_locks(outlined, monkeypatch):
    """Its tree is another: what was locked by the number of a node is not."""
    outline.toggle_lock(outlined, row_of(outlined, "mug").node)
    outlined.put(things=Things(locked=frozenset({10**6})))
    act(opening.reload, outlined)
    assert outlined.state.session.things.locked == frozenset()
    outline.toggle_lock(outlined, 0)  # of another number of Gaussians
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
