"""Selecting, hiding, deleting, transforming and cropping; and what is asked before edits are lost."""

import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.cli.app import parse
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Scene, look_at
from langsplat_core.scene.transform import AXES, IDENTITY, moving, rotating, scaling
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.actions.editing import take
from langsplat_viewer.camera.controls import from_camera
from langsplat_viewer.marks import Drawn, Stroke, outlines
from langsplat_viewer.projects import BUNDLED
from langsplat_viewer.session import Move
from langsplat_viewer.state import EditForm, ExportForm, QueryAnswer, Saved
from tests.support.fakes import CENTRES, PER_BLOB
from tests.support.windowless import (
    SCENES,
    FakeSurface,
    act,
    answer,
    ask,
    blob,
    errors,
    marked,
    means,
    open_scene,
    phrases,
    put_scene,
    recorded,
    result,
    settle,
)


@pytest.fixture
def searched(opened):
    """One answer: the book."""
    ask(opened, "book")
    return opened


def test_hidden_and_deleted_are_never_selected(opened):
    for action, expected in (
        (editing.select_all, ("mug book plant", "", "")),
        (editing.select_none, ("", "", "")),
        (partial(take, found=blob("book")), ("book", "", "")),
        (editing.invert_selection, ("mug plant", "", "")),
        (partial(take, found=blob("mug")), ("mug", "", "")),
        (editing.select_alike, ("mug", "", "")),
        (editing.hide_selected, ("", "mug", "")),
        (partial(take, found=blob("plant")), ("plant", "mug", "")),
        (editing.delete_selected, ("", "mug", "plant")),
        (editing.select_all, ("book", "mug", "plant")),
        (editing.invert_selection, ("", "mug", "plant")),
        (editing.show_hidden, ("", "", "plant")),
        (editing.select_all, ("mug book", "", "plant")),
        (partial(take, found=blob("mug")), ("mug", "", "plant")),
        (editing.isolate_selected, ("mug", "book", "plant")),
    ):
        act(action, opened)
        assert marked(opened) == expected, action
    take(opened, blob("book"))
    assert "hidden" in opened.state.messages[-1].text


@pytest.mark.parametrize(
    ("mode", "selected"),
    [("replace", "book plant"), ("add", "mug book plant"), ("remove", "mug"), ("intersect", "book")],
)
def test_selection_is_combined_by_the_mode(opened, mode, selected):
    take(opened, blob("mug") | blob("book"))
    editing.set_tools(opened, mode=mode)
    take(opened, blob("book") | blob("plant"))
    assert marked(opened)[0] == selected


def test_each_change_of_marks_is_one_step(opened):
    take(opened, blob("mug"))
    editing.hide_selected(opened)
    take(opened, blob("book"))
    editing.delete_selected(opened)
    editing.show_hidden(opened)
    states = [("", "", "book"), ("", "mug", "book"), ("book", "mug", ""), ("", "mug", ""), ("mug", "", "")]
    states.append(("", "", ""))
    assert marked(opened) == states[0]
    for state in states[1:]:
        editing.undo(opened)
        assert marked(opened) == state
    for state in states[-2::-1]:
        editing.redo(opened)
        assert marked(opened) == state


def test_change_without_effect_is_no_step(opened):
    editing.select_none(opened)
    editing.show_hidden(opened)
    take(opened, blob("mug"))
    take(opened, blob("mug"))
    assert len(opened.history.past) == 1
    editing.use_tool(opened, "brush")
    editing.set_tools(opened, brush=0.1)
    assert len(opened.history.past) == 1


def test_answers_and_instances_are_selected(searched):
    editing.select_query(searched)
    assert marked(searched)[0] == "book"
    ask(searched, "mug")
    editing.select_query(searched, mode="add")
    assert marked(searched)[0] == "mug book"
    (thing,) = answer(searched, 0).things
    take(searched, np.isin(np.arange(360), thing.members))
    np.testing.assert_array_equal(np.flatnonzero(searched.state.marks.selected), thing.members)
    editing.select_none(searched)
    queries.remove(searched, "mug")
    absent = replace(result(searched), judgement=result(searched).judgement.absent)
    searched.state.answers["book"] = QueryAnswer(absent)
    editing.select_query(searched)
    assert "'book' is not here" in searched.state.messages[-1].text
    queries.remove(searched, "book")
    editing.select_query(searched)
    assert "search for something first" in searched.state.messages[-1].text
    assert marked(searched) == ("", "", "")


def test_growing_and_shrinking_follow_the_surface(opened):
    means = opened.state.open.scene.gaussians.means
    core = np.linalg.norm(means, axis=1) < 0.15
    take(opened, core)
    editing.set_tools(opened, reach=0.15)
    act(editing.grow_selection, opened)
    grown = opened.state.marks.selected.copy()
    assert core.sum() < grown.sum()
    assert (grown >= core).all()
    assert not (grown & ~blob("book")).any()  # the others are not on its surface
    act(editing.shrink_selection, opened)
    assert opened.state.marks.selected.sum() < grown.sum()
    editing.undo(opened)
    assert (opened.state.marks.selected == grown).all()


def test_late_result_of_another_scene_is_dropped(opened):
    take(opened, blob("mug"))
    editing.grow_selection(opened)
    opened.engine = None  # another one is being shown
    settle(opened)
    assert marked(opened)[0] == "mug"


def test_next_scene_has_no_marks_and_keeps_the_tool(opened):
    take(opened, blob("mug"))
    editing.hide_selected(opened)
    editing.use_tool(opened, "lasso")
    editing.set_tools(opened, mode="add")
    open_scene(opened, "plain.ply")
    assert marked(opened) == ("", "", "")
    assert (opened.state.tools.tool, opened.state.tools.mode) == ("lasso", "add")


# Selecting with the mouse: what a stroke encloses, and what becomes of it. No window.

SIZE = (400, 300)
FRONT = look_at(np.array([0, 0, -5.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)


@pytest.fixture
def front(opened):
    """From straight ahead, so that the blobs lie in a row: mug, book, plant from left to right."""
    settings.resize(opened, *SIZE)
    viewpoint.move(opened, lambda view: from_camera(FRONT, opened.state.open.extent))
    return opened


def place(viewer, point) -> tuple[float, float]:
    """Of a world point, as fractions of the picture."""
    (pixel,), _ = viewer.state.open.view.camera(*SIZE).project(np.asarray(point, float)[None])
    return pixel[0] / SIZE[0], pixel[1] / SIZE[1]


def around(viewer, centre, radius: float = 0.58) -> list[tuple[float, float]]:
    """Places all around a blob."""
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return [place(viewer, centre + radius * np.array([np.cos(t), np.sin(t), 0])) for t in turns]


def draw(viewer, tool, places, mode=None) -> str:
    """A stroke of a tool, when all that it began is done; returns what is selected."""
    editing.use_tool(viewer, tool)
    editing.begin_stroke(viewer, *places[0])
    for u, v in places[1:]:
        editing.extend_stroke(viewer, u, v)
    act(editing.end_stroke, viewer, mode)
    return marked(viewer)[0]


def corners(viewer, centre, half: float = 0.58) -> list[tuple[float, float]]:
    return [place(viewer, centre + half * np.array([sign, sign, 0])) for sign in (-1, 1)]


def test_stroke_selects_what_it_encloses(front):
    assert draw(front, "rectangle", corners(front, CENTRES[0])) == "mug"
    assert draw(front, "rectangle", corners(front, CENTRES[2])[::-1], "add") == "mug plant"
    editing.undo(front)
    assert marked(front)[0] == "mug"
    assert draw(front, "lasso", around(front, CENTRES[1])) == "book"
    editing.set_tools(front, brush=0.12)
    assert draw(front, "brush", [place(front, CENTRES[0]), place(front, CENTRES[1])]) == "mug book"
    editing.set_tools(front, brush=0.01)
    draw(front, "brush", [place(front, CENTRES[2])])
    assert 0 < front.state.marks.selected.sum() < PER_BLOB


@pytest.mark.parametrize("tool", ["sphere", "box"])
def test_sphere_and_box_are_as_large_as_the_drag(front, tool, monkeypatch):
    monkeypatch.setattr(FakeSurface, "point_at", lambda self, u, v: CENTRES[2])
    assert draw(front, tool, [place(front, CENTRES[2]), place(front, CENTRES[2] + [0.7, 0, 0])]) == "plant"
    draw(front, tool, [place(front, CENTRES[2])])  # a click
    offsets = np.abs(front.state.open.scene.gaussians.means - CENTRES[2])
    far = np.linalg.norm(offsets, axis=1) if tool == "sphere" else offsets.max(1)
    reach = front.state.tools.reach * front.state.open.extent.radius
    np.testing.assert_array_equal(front.state.marks.selected, far <= reach)
    assert front.state.marks.selected.any()


@pytest.mark.parametrize("perspective", [True, False])
def test_stroke_leaves_out_occluded_gaussians(front, monkeypatch, perspective):
    """Depths count from the eye, with perspective and without."""
    if not perspective:
        viewpoint.toggle_orthographic(front)
    monkeypatch.setattr(FakeSurface, "depths", lambda self: np.full((30, 40), 4.95))
    draw(front, "rectangle", corners(front, CENTRES[1]))
    z = front.state.open.scene.gaussians.means[:, 2]
    in_front = front.state.marks.selected
    editing.set_tools(front, only_visible=False)
    assert draw(front, "rectangle", corners(front, CENTRES[1])) == "book"
    np.testing.assert_array_equal(in_front, front.state.marks.selected & (z + 5 <= 4.95 * 1.03))
    assert 20 < in_front.sum() < 100


def test_click_selects_the_thing_at_the_chosen_level(front, monkeypatch):
    monkeypatch.setattr(FakeSurface, "point_at", lambda self, u, v: CENTRES[1])
    assert draw(front, "thing", [(0.5, 0.5)]) == "book"
    editing.undo(front)
    assert marked(front)[0] == ""


def test_click_without_surface_or_field_says_why(front, monkeypatch):
    draw(front, "sphere", [(0.95, 0.5)])  # where the picture is empty
    assert "nothing under the cursor" in front.state.messages[-1].text
    put_scene(front, Scene(front.state.open.scene.gaussians))
    draw(front, "thing", [(0.5, 0.5)])
    assert "language field" in errors(front)[-1]
    assert marked(front) == ("", "", "")


def test_escape_closes_help_then_stroke_then_tool(front):
    editing.use_tool(front, "lasso")
    editing.begin_stroke(front, 0.1, 0.1)
    front.state.show_help = True
    settings.escape(front)
    assert front.state.tools.stroke is not None
    settings.escape(front)
    assert (front.state.tools.stroke, front.state.tools.tool) == (None, "lasso")
    editing.end_stroke(front)  # of nothing
    settings.escape(front)
    assert (front.state.tools.tool, marked(front)) == (None, ("", "", ""))


# Saving what is selected, the rest and the scene; and what is asked before deletions are lost.


def drawn(tool, path, centre=None) -> Drawn:
    return Drawn(tool, Stroke(tuple(path), centre), FRONT, 0.03, 0.5)


def test_outlines_follow_the_stroke():
    (rectangle,) = outlines(drawn("rectangle", [(0.2, 0.3), (0.6, 0.5)]))
    assert rectangle.tolist() == [[0.2, 0.3], [0.6, 0.3], [0.6, 0.5], [0.2, 0.5], [0.2, 0.3]]
    (lasso,) = outlines(drawn("lasso", [(0.2, 0.3), (0.6, 0.5), (0.1, 0.9)]))
    assert lasso[0].tolist() == lasso[-1].tolist()
    (brush,) = outlines(drawn("brush", [(0.2, 0.3), (0.6, 0.5)]))
    assert len(brush) == 2
    assert outlines(drawn("thing", [(0.2, 0.3)])) == []
    end = (0.6, 0.5)
    (circle,) = outlines(drawn("sphere", [(0.5, 0.5), end], (0.0, 0.0, 0.0)))
    np.testing.assert_allclose(np.abs(circle - end).max(1).min(), 0, atol=1e-9)
    assert len(outlines(drawn("box", [(0.5, 0.5), end], (0.0, 0.0, 0.0)))) == 12
    behind = drawn("box", [(0.5, 0.5)], (0.0, 0.0, -5.0))  # the eye is inside
    assert len(outlines(behind)) < 12


@pytest.fixture
def pruned(opened):
    """The plant is deleted."""
    take(opened, blob("plant"))
    editing.delete_selected(opened)
    return opened


def kept_in(folder: Path) -> int:
    """Gaussians of what was saved as "edited"."""
    return len(load_scene(folder / "blobs-edited-001.ply").gaussians)


def form_of(viewer, title: str, **values: object) -> ExportForm:
    """The dialog's fields as they are at first, but for `values`."""
    saving.ask_export(viewer, title)
    return replace(viewer.state.export_form, **values)


@pytest.mark.parametrize("title", saving.EXPORTS)
def test_exports_are_commands_of_the_command_line(opened, title):
    row, form = saving.EXPORTS[title], form_of(opened, title)
    assert title in saving.exports()
    switches = [flag for flag in row.options if saving.OPTIONS[flag][1] is False]
    values = [f"{flag}={value:g}" for flag, value in form.values.items() if flag not in switches]
    for suffix in row.sizes:
        words = row.words.format(scene="a.ply", out=f"b{suffix}", encoder="--encoder=mine").split()
        assert getattr(parse([*words, *values, *switches]), "encoder", "") in ("", None, "mine")


@pytest.mark.parametrize("suffix", [".ply", ".spz", ".glb", ".splat"])
def test_export_size_is_said_before_it_is_written(viewer, tmp_path, suffix):
    viewer.services = replace(viewer.services, load_scene=load_scene)
    open_scene(viewer, BUNDLED)
    said, unit = saving.export_size(viewer, form_of(viewer, "scene", suffix=suffix)).split()[1:]
    save_scene(tmp_path / f"a{suffix}", viewer.state.open.scene, tell=False)
    written = sum(path.stat().st_size for path in tmp_path.iterdir())
    assert float(said) == pytest.approx(written / 1e6, rel=0.1)
    assert unit == "MB"


def test_folder_to_export_to_has_a_free_name(opened):
    saving.choose_export(opened, form_of(opened, "map for a robot"))
    assert (opened.state.choice.kind, opened.state.choice.start.name) == ("save", "blobs-map-001")
    said = saving.export_size(opened, form_of(opened, "scene", suffix=".splat"))
    assert said == "About 0.012 MB"  # and not 0.0


@pytest.mark.parametrize(
    ("title", "name", "what"),
    [("web page", "a.html", "opens in any browser"), ("scene", "a.spz", "240 Gaussians")],
)
def test_edited_scene_is_exported(pruned, tmp_path, title, name, what):
    saving.run_export(pruned, tmp_path / name, form_of(pruned, title, suffix=Path(name).suffix))
    recorded(pruned)
    said = pruned.state.messages[-1]
    assert said.file == tmp_path / name
    assert f"saved {tmp_path / name}" in said.text
    assert what in said.text


def test_waiting_export_does_not_replace_an_earlier_one(pruned, tmp_path):
    gate = threading.Event()
    pruned.recorder.submit("before", lambda progress: gate.wait(60), lambda done: None, pruned.say_error)
    for _ in range(2):
        saving.run_export(pruned, tmp_path / "a.html", form_of(pruned, "web page"))
    gate.set()
    recorded(pruned)
    assert ["by an earlier export" in text for text in errors(pruned)] == [True]


SLOW = "import sys, time; print(sys.argv, flush=True); time.sleep(60)"
FAILS = "import sys; sys.exit(f'langsplat: {sys.argv[1]} has no cameras; {sys.argv[-1]}')"


def test_cancelled_export_ends_its_command(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "program", lambda: [sys.executable, "-c", SLOW])
    began = time.monotonic()
    saving.run_export(opened, tmp_path / "a.glb", form_of(opened, "mesh"))
    opened.recorder.cancel()
    recorded(opened)
    assert time.monotonic() - began < 30
    assert list(tmp_path.iterdir()) == []


def test_failed_export_of_a_command_says_why(opened, tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "program", lambda: [sys.executable, "-c", FAILS])
    opened.services = replace(opened.services, encoder_id="my own")
    saving.run_export(opened, tmp_path / "a.ply", form_of(opened, "labels"))
    recorded(opened)
    assert errors(opened) == ["describe has no cameras; --encoder=my own"]
    opened.state.open = replace(opened.state.open, path=tmp_path / "blobs.ply")
    opened.state.path.touch()
    saving.run_export(opened, opened.state.path, form_of(opened, "scene"))
    recorded(opened)
    assert "would replace the original scene" in errors(opened)[-1]
    saving.run_export(opened, opened.state.path / "a.html", form_of(opened, "web page"))
    recorded(opened)
    assert errors(opened)[-1].endswith("is a file, not a folder; choose another name")


def test_exported_selection_has_its_field(pruned, tmp_path):
    take(pruned, blob("mug"))
    saving.run_export(pruned, tmp_path / "mug.ply", form_of(pruned, "scene", only_selected=True))
    recorded(pruned)
    written, means = load_scene(tmp_path / "mug.ply"), SCENES["blobs.ply"].gaussians.means
    np.testing.assert_array_equal(written.gaussians.means, means[blob("mug")])
    assert (len(written.language), len(written.cameras)) == (120, 3)
    assert pruned.state.is_unsaved  # the scene is not
    saving.run_export(pruned, tmp_path / "all.ply", form_of(pruned, "scene"))
    recorded(pruned)
    assert not pruned.state.is_unsaved


def test_edited_scene_never_overwrites(pruned, tmp_path):
    taken = tmp_path / "blobs-edited-001.langsplat.safetensors"  # what would belong to the first name
    taken.write_text("precious")
    saving.finish_writing(pruned)  # nothing is
    for _ in range(2):  # both are asked for before either is written
        saving.save_edited(pruned, tmp_path)
    saving.finish_writing(pruned)  # waits for both
    assert taken.read_text() == "precious"
    written = {path.name for path in tmp_path.glob("*.ply")}
    assert written == {"blobs-edited-002.ply", "blobs-edited-003.ply"}


def test_deletion_is_unsaved_until_exported(pruned, tmp_path):
    for action, unsaved in (
        (editing.undo, False),
        (editing.redo, True),
        (partial(saving.save_edited, folder=tmp_path), False),
        (partial(take, found=blob("mug")), False),
        (editing.delete_selected, True),
    ):
        act(action, pruned)
        assert pruned.state.is_unsaved == unsaved, action
    assert kept_in(tmp_path) == 240


def test_broken_scene_after_discarding_keeps_edits(pruned):
    opening.open_scene(pruned, Path("broken.ply"))
    act(saving.go_on, pruned)
    assert marked(pruned) == ("", "", "plant")
    assert pruned.state.is_unsaved


def test_failed_saving_stays_in_the_scene(pruned, tmp_path):
    saving.quit_viewer(pruned)
    (tmp_path / "file").write_text("")
    act(saving.save_and_leave, pruned, tmp_path / "file")
    assert "not saved" in errors(pruned)[-1]
    assert (pruned.state.may_close, pruned.state.is_unsaved) == (False, True)


def test_nothing_is_written_once_all_is_deleted(opened, tmp_path):
    editing.select_all(opened)
    editing.delete_selected(opened)
    for title in saving.exports():
        saving.ask_export(opened, title)
    assert opened.state.export_form is None
    saving.quit_viewer(opened)
    act(saving.save_and_leave, opened, tmp_path)
    assert not opened.state.may_close
    assert [text.partition(": all ")[0] for text in errors(opened)] == ["nothing to export", "not saved"]
    assert list(tmp_path.iterdir()) == []


def test_ending_process_saves_unsaved_edits_and_says_where(pruned, tmp_path, capsys):
    pruned.state.open = replace(pruned.state.open, path=tmp_path / "blobs.ply")
    saving.end(pruned, tmp_path / "gone")  # so it goes beside the scene
    assert not pruned.state.may_close
    settle(pruned)
    assert pruned.state.may_close
    assert kept_in(tmp_path) == 240
    assert f"saved {tmp_path / 'blobs-edited-001.ply'}" in capsys.readouterr().err


def test_taught_name_is_found_and_saved(opened, tmp_path):
    take(opened, blob("plant"))
    act(editing.name_selection, opened, "grandma's mug")
    assert phrases(opened) == ["grandma's mug"]
    np.testing.assert_array_equal(result(opened).members, blob("plant"))
    act(saving.save_edited, opened, tmp_path)
    (saved,) = tmp_path.glob("*.ply")
    assert [word.name for word in load_scene(saved).language.taught] == ["grandma's mug"]
    assert errors(opened) == []


def test_unusable_name_says_why(opened):
    editing.name_selection(opened, "cup")
    assert "nothing is selected" in opened.state.messages[-1].text
    take(opened, blob("plant"))
    act(editing.name_selection, opened, "the")
    assert "'the' cannot be a name" in errors(opened)[-1]
    assert opened.state.session.queries == ()


# Transforms and crops of the scene and of the selection, as seen and as saved.


MUG = CENTRES[0]
STEP = np.array([0.0, 2.0, -1.0])


def selected_mug(viewer) -> np.ndarray:
    ask(viewer, "mug")
    editing.select_query(viewer)
    chosen: np.ndarray = viewer.state.marks.selected
    assert 0 < chosen.sum() < len(chosen)
    return chosen


def test_transform_moves_only_the_selection(opened):
    chosen, before = selected_mug(opened), means(opened)
    place, cameras = result(opened, 0).place, opened.state.open.scene.cameras
    act(editing.transform, opened, moving(STEP))
    np.testing.assert_allclose(means(opened)[chosen], before[chosen] + STEP, atol=1e-5)
    np.testing.assert_array_equal(means(opened)[~chosen], before[~chosen])
    assert opened.state.open.scene.cameras is cameras
    np.testing.assert_allclose(result(opened, 0).place, place + STEP, atol=1e-4)
    np.testing.assert_array_equal(opened.state.marks.selected, chosen)
    act(editing.name_selection, opened, "trophy")  # what is taught goes along
    act(editing.transform, opened, moving(STEP))
    assert opened.engine.is_taught("trophy")
    assert [word.name for word in opened.state.open.scene.language.taught] == ["trophy"]
    opened.state.saved = Saved(opened.state.session)
    open_scene(opened, "plain.ply")  # begins without transforms, and has no language field
    assert (opened.state.session.moves, opened.state.open.in_file) == ((), opened.state.open.scene)
    before = means(opened)
    act(editing.transform, opened, moving(STEP))
    np.testing.assert_allclose(means(opened), before + STEP, atol=1e-5)
    assert opened.state.open.scene.language is None


def test_transform_of_the_scene_moves_its_cameras(opened):
    up, before = opened.state.open.extent.up, means(opened)
    eyes = [camera.position for camera in opened.state.open.scene.cameras]
    to = rotating(AXES["z"], 90).then(scaling(3)).then(moving(STEP))
    editing.transform(opened, to)
    np.testing.assert_allclose(means(opened), to.points(before), atol=1e-4)
    moved = [camera.position for camera in opened.state.open.scene.cameras]
    np.testing.assert_allclose(moved, to.points(np.array(eyes)), atol=1e-9)
    np.testing.assert_allclose(opened.state.open.extent.up, to.rotation @ up, atol=1e-6)


def test_a_session_that_leads_too_far_is_not_adopted(opened):
    before, shown = opened.state.session, opened.state.open.scene
    far = replace(before, level="part", moves=(Move(scaling(1e9)), Move(scaling(1e9))))
    with pytest.raises(InputError):
        editing.adopt(opened, far)
    assert (opened.state.session, opened.state.open.scene) == (before, shown)


def test_transforms_are_undone_exactly(opened):
    chosen, first = selected_mug(opened), means(opened)
    place = result(opened, 0).place
    editing.transform(opened, rotating(AXES["x"], 33).about(MUG))
    editing.transform(opened, moving(STEP))
    editing.select_none(opened)
    act(editing.transform, opened, scaling(0.5))
    last = means(opened)
    for _ in range(4):
        editing.undo(opened)
    settle(opened)
    np.testing.assert_array_equal(means(opened), first)
    np.testing.assert_array_equal(opened.state.marks.selected, chosen)
    np.testing.assert_allclose(result(opened, 0).place, place, atol=1e-6)
    assert not opened.state.is_unsaved
    for _ in range(4):
        editing.redo(opened)
    settle(opened)
    np.testing.assert_array_equal(means(opened), last)
    assert opened.state.is_unsaved
    for _ in range(12):  # a full turn: of the same part all are one, and nothing to float32
        editing.transform(opened, rotating(AXES["y"], 30))
    assert len(opened.state.session.moves) == 2
    np.testing.assert_allclose(means(opened), last, atol=1e-5)


def test_held_gizmo_previews_the_transform(opened):
    chosen = selected_mug(opened)
    before, shown = means(opened), opened.state.request((32, 24))
    editing.preview(opened, moving(STEP))
    seen = opened.state.request((32, 24))
    assert seen != shown
    np.testing.assert_allclose(seen.scene.scene.gaussians.means[chosen], before[chosen] + STEP, atol=1e-5)
    assert means(opened) is before
    assert opened.state.request((32, 24)) == seen  # nothing is drawn anew while it rests
    with pytest.raises(InputError):
        editing.preview(opened, moving(np.array([1e39, 0, 0])))
    assert opened.state.request((32, 24)) == seen
    editing.transform(opened, IDENTITY)
    assert opened.state.request((32, 24)).scene.source is opened.state.open.scene


def test_transformed_scene_is_saved_as_seen(opened, tmp_path):
    selected_mug(opened)
    editing.transform(opened, moving(STEP))
    act(saving.save_edited, opened, tmp_path)
    made = load_scene(next(tmp_path.glob("*.ply")))
    np.testing.assert_array_equal(made.gaussians.means, means(opened))
    assert made.language is not None
    assert not opened.state.is_unsaved
    editing.transform(opened, moving(STEP))
    opening.open_scene(opened, Path("plain.ply"))  # is asked about first
    assert opened.state.leaving is not None


def test_cropping_keeps_earlier_deletions(opened):
    chosen = selected_mug(opened)
    editing.delete_selected(opened)
    for form in (EditForm(), EditForm(low=(-99.0,) * 3, high=(99.0,) * 3)):  # first the box is shown
        opened.state.edit_form = form
        editing.crop(opened)
        np.testing.assert_array_equal(opened.state.marks.deleted, chosen)


def test_panel_numbers_transform_about_the_middle(opened):
    """Scaled and rotated about the middle of the selection, then moved; then the fields are neutral again."""
    before = opened.state.open.scene
    refused = (EditForm(scale=0), EditForm(scale=-1), EditForm(move=(1e39, 0.0, 0.0)))
    for count, form in enumerate(refused, start=1):
        opened.state.edit_form = form
        editing.apply_form(opened)
        assert len(errors(opened)) == count
    assert opened.state.open.scene is before
    assert opened.history.past == []
    chosen, before = selected_mug(opened), means(opened)
    centre = editing.pivot(opened, opened.state.open)
    form = EditForm(move=(1.0, 0.0, 0.0), rotate=(0.0, 0.0, 90.0), scale=2.0)
    opened.state.edit_form = form
    editing.apply_form(opened)
    x, y, z = (before[chosen] - centre).T
    expected = centre + np.stack([1 - 2 * y, 2 * x, 2 * z], 1)
    np.testing.assert_allclose(means(opened)[chosen], expected, atol=1e-5)
    assert opened.state.edit_form == EditForm()
