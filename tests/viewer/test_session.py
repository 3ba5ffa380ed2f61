"""The session: undo and redo, projects, and files of earlier versions."""

import gc
import json
import tracemalloc
import weakref
import zlib
from base64 import b64encode
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.cameras import read_cameras
from langsplat_core.scene import Scene
from langsplat_core.scene.transform import moving, place_scene
from langsplat_viewer import options, projects
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.actions.editing import mark
from langsplat_viewer.camera.controls import orbit
from langsplat_viewer.marks import Marks
from langsplat_viewer.projects import (
    NO_GROUPS,
    NOT_COMPARED,
    load_preferences,
    read_flight,
    read_project,
    save_preferences,
    write_project,
)
from langsplat_viewer.rendering.request import Clip, Splats
from langsplat_viewer.session import Note, Preferences, Query, Ruler, Things
from langsplat_viewer.viewer import GESTURE, MOST_STEPS, Viewer
from tests.support.file_kinds import FileKind, few_and_many, in_json
from tests.support.scenes import random_gaussians
from tests.support.windowless import (
    SCENES,
    act,
    answer,
    ask,
    blob,
    errors,
    go,
    marked,
    means,
    new_viewer,
    open_scene,
    phrases,
    put_scene,
    render_image,
    result,
    settle,
)


def test_undo_and_redo_restore_queries(opened):
    ask(opened, "mug", "book")
    editing.undo(opened)
    assert phrases(opened) == ["mug"]
    editing.undo(opened)
    assert phrases(opened) == []
    assert opened.state.session.picture.display == "rgb"
    editing.undo(opened)
    assert "nothing to undo" in opened.state.messages[-1].text
    editing.redo(opened)
    act(editing.redo, opened)
    assert phrases(opened) == ["mug", "book"]
    assert [query.slot for query in opened.state.session.queries] == [0, 1]
    assert (opened.state.session.picture.display, len(opened.state.shown_results())) == ("relevancy", 2)
    editing.redo(opened)
    assert "nothing to redo" in opened.state.messages[-1].text


NAMED = {
    "select 360 Gaussians": editing.select_all,
    "search 'mug'": lambda viewer: ask(viewer, "mug"),
    "transform": lambda viewer: editing.transform(viewer, moving(np.ones(3))),
    "display": lambda viewer: settings.set_display(viewer, "depth"),
}


@pytest.mark.parametrize("words", NAMED)
def test_undo_and_redo_name_their_step(opened, words):
    NAMED[words](opened)
    assert editing.named_step(opened, "undo") == f"undo {words}"
    editing.undo(opened)
    assert opened.state.messages[-1].text == f"undo {words}"
    assert editing.named_step(opened, "redo") == f"redo {words}"


def test_undo_restores_a_removed_query_with_its_colour(opened):
    ask(opened, "mug", "book")
    queries.set_cut(opened, "mug", 0.6)
    mug, count = opened.state.session.queries[0], result(opened, 0).members.sum()
    queries.remove(opened, "mug")
    act(editing.undo, opened)
    assert opened.state.session.queries[0] == mug == Query("mug", 0.6, 0, 1)
    assert (result(opened, 0).found, len(answer(opened, 0).things)) == (True, 1)
    assert result(opened, 0).members.sum() == count


@pytest.mark.parametrize("leave", [lambda v: queries.remove(v, phrases(v)[-1]), editing.undo])
def test_history_keeps_no_answers_of_removed_queries(opened, leave):
    """Each has a number for every Gaussian and level."""
    ask(opened, "mug")
    stays, gone = result(opened, 0), []
    for word in ("book", "plant"):
        ask(opened, word)
        gone.append(weakref.ref(result(opened, -1)))
        opened.state.panes()
        leave(opened)
    gc.collect()
    assert [there() for there in gone] == [None, None]
    assert result(opened, 0) is stays
    (editing.redo if leave is editing.undo else editing.undo)(opened)
    settle(opened)
    assert opened.state.session.queries[-1].phrase == "plant"
    assert result(opened, -1).found


def test_late_answer_of_a_removed_query_is_dropped(opened):
    queries.ask(opened, "mug")
    act(queries.remove, opened, "mug")
    assert opened.state.answers == {}
    editing.undo(opened)
    assert answer(opened).pending
    settle(opened)
    assert result(opened).found


def test_undo_restores_the_level_and_ends_with_the_scene(opened):
    ask(opened, "mug")
    queries.show(opened, "mug", shown=False)
    act(queries.set_level, opened, "part")
    act(editing.undo, opened)
    assert (opened.state.session.level, result(opened).level) == ("auto", 2)
    editing.undo(opened)
    assert opened.state.session.queries[0].slot == 0
    for _ in range(MOST_STEPS):
        settings.set_display(opened, "depth")
        settings.set_display(opened, "rgb")
    assert len(opened.history.past) == MOST_STEPS
    open_scene(opened, "bare.ply")
    assert opened.history.past == []


SETTINGS = {
    "picture": lambda v: settings.set_picture(v, replace(v.state.session.picture, dim=0.2)),
    "display": lambda v: settings.set_display(v, "depth"),
    "colour map": lambda v: settings.set_picture(v, replace(v.state.session.picture, colour_map="viridis")),
    "wipe": settings.toggle_wipe,
    "levels": settings.toggle_levels,
    "line": lambda v: settings.move_line(v, 0.3),
    "splats": lambda v: v.change(splats=Splats(0.5, 0)),
    "cut": lambda v: settings.set_clip(v, Clip(1.0, 2.0)),
    "overlay": lambda v: settings.toggle_overlay(v, "grid"),
    "backdrop": lambda v: settings.set_picture(v, replace(v.state.session.picture, transparent=True)),
    "latents": lambda v: settings.set_display(v, "latent", 1),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_setting_is_undone_in_one_step(opened, name):
    before = opened.state.session
    SETTINGS[name](opened)
    after = opened.state.session
    assert after != before
    if name not in ("wipe", "levels", "overlay"):  # which would go back
        SETTINGS[name](opened)  # changes nothing, and is no step
    assert len(opened.history.past) == 1
    settings.toggle_measuring(opened)  # is never undone
    SETTINGS["wipe" if name == "levels" else "levels"](opened)
    for wanted in (after, before):
        editing.undo(opened)
        assert opened.state.session == replace(wanted, ruler=Ruler(measures=True))
    assert opened.history.past == []
    editing.redo(opened)
    assert opened.state.session == replace(after, ruler=Ruler(measures=True))


def slide(viewer, seconds: float, dim: float) -> None:
    viewer.clock = seconds
    settings.set_picture(viewer, replace(viewer.state.session.picture, dim=dim))


def test_slider_gesture_is_one_step(opened):
    for frame in range(10):
        slide(opened, 5 + 0.1 * frame, 0.4 - 0.01 * frame)
    assert len(opened.history.past) == 1
    slide(opened, 5.9 + 1.1 * GESTURE, 0.9)
    assert len(opened.history.past) == 2
    editing.undo(opened)
    assert opened.state.session.picture.dim == pytest.approx(0.31)
    slide(opened, opened.clock, 0.8)  # after an undo a step of its own
    editing.undo(opened)
    assert opened.state.session.picture.dim == pytest.approx(0.31)
    editing.undo(opened)
    assert opened.state.session.picture.dim == PictureConfig().dim


def test_undo_of_a_setting_keeps_the_same_mask_objects(opened):
    """Else the scene would be made anew for every slider."""
    editing.select_all(opened)
    settings.toggle_wipe(opened)
    marks = opened.state.marks
    editing.undo(opened)
    editing.redo(opened)
    assert opened.state.marks is marks
    editing.hide_selected(opened)
    hidden = opened.state.marks.hidden
    mark(opened, replace(opened.state.marks, selected=~hidden | True))
    editing.undo(opened)
    assert opened.state.marks.hidden is hidden


def changed(marks: Marks, rng: np.random.Generator, step: int) -> Marks:
    if step % 2:
        return replace(marks, selected=marks.selected & False, hidden=marks.hidden | marks.selected)
    return replace(marks, selected=(rng.uniform(size=len(marks.selected)) < 0.02) & marks.shown)


def test_history_of_a_million_gaussians_takes_little_memory(viewer):
    """At random, so that nothing could be shared."""
    count, rng = 1_000_000, np.random.default_rng(0)
    put_scene(viewer, Scene(random_gaussians(count)))
    tracemalloc.start()
    try:
        for step in range(MOST_STEPS):
            mark(viewer, changed(viewer.state.marks, rng, step))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(viewer.history.past) == MOST_STEPS
    now = viewer.state.marks
    own = sum(mask.nbytes for mask in (now.selected, now.hidden))
    assert held - own < 15e6


# Projects: all that was asked, seen, noted and edited comes back; a broken file is one line.


@pytest.fixture
def saved(opened, tmp_path, monkeypatch) -> Path:
    """The file of a project with something of everything in it."""
    monkeypatch.chdir(tmp_path)
    return save_session(opened, tmp_path)


def save_session(opened: Viewer, folder: Path) -> Path:
    (folder / "blobs.ply").touch()  # what is in it comes from `windowless.load`
    ask(opened, "mug", "book", "plant", "mug or book")
    queries.set_cut(opened, "book", 0.6)
    queries.show(opened, "plant", shown=False)
    editing.take(opened, blob("plant"))
    act(editing.transform, opened, moving(np.array([0.0, 1.0, 0.0])))
    editing.hide_selected(opened)
    editing.take(opened, blob("book"))
    looks = replace(opened.state.session.picture, dim=0.7, heat_scale=(0.4, 0.9), colour_map="magma")
    settings.set_picture(opened, looks)
    settings.set_clip(opened, Clip(0.5, 40.0))
    viewpoint.move(opened, lambda view: orbit(view, 0.3, 0.1))
    viewpoint.add_keyframe(opened)
    settings.toggle_pinning(opened)
    settings.pin_at(opened, 0.5, 0.5)
    settings.write_note(opened, opened.state.session.notes[0], 'a "note" <b>of</b> 1987')
    opened.state.preferences = replace(opened.state.preferences, panels=("Search", "Notes"))
    path = saving.save_project(opened, folder)
    assert path.name == "blobs-001.langsplat"
    return path


@pytest.fixture
def again(saved):
    """Another viewer with the project open."""
    with new_viewer() as made:
        act(opening.open_file, made, saved)
        yield made


def test_project_restores_the_whole_session(opened, saved, again):
    before, after = opened.state, again.state
    assert errors(again) == []
    for place in range(4):
        np.testing.assert_array_equal(result(again, place).members, result(opened, place).members)
    assert marked(again) == marked(opened) == ("book", "plant", "")
    np.testing.assert_allclose(means(again), means(opened), atol=1e-6)
    for part in fields(before.session):
        if part.name not in ("moves", "keyframes"):  # of arrays
            assert getattr(after.session, part.name) == getattr(before.session, part.name), part.name
    np.testing.assert_allclose(after.open.view.eye, before.open.view.eye, atol=1e-9)
    assert after.open.view.intrinsics == before.open.view.intrinsics
    np.testing.assert_allclose(after.open.view.target, before.open.view.target, atol=1e-6)
    assert len(after.session.keyframes) == 1
    assert settings.take(again.state, "wanted_panel") == ""
    assert after.preferences.panels == ("Search", "Notes")
    assert not after.is_unsaved
    assert (before.preferences.recent[0], after.preferences.recent[0]) == (str(saved), str(saved))
    queries.remove_all(again)
    act(opening.open_file, again, saved)
    assert len(after.session.queries) == 4
    assert saving.save_project(again, Path("/nowhere")) == saved  # where it came from
    assert list(saved.parent.glob("*.langsplat")) == [saved]


def test_two_windows_save_one_project_and_lose_nothing(saved, opened, again):
    """What the other one has written since is kept beside it, and said."""
    settings.pin_at(opened, 0.4, 0.5)
    assert saving.save_project(opened) == saved
    settings.pin_at(again, 0.3, 0.5)
    act(saving.save_project, again)
    apart = saved.with_name("blobs-001-other-001.langsplat")
    assert apart.name in errors(again)[-1]
    for path, window in ((apart, opened), (saved, again)):
        assert read_project(path).session.notes == window.state.session.notes
    assert again.state.saved.session == again.state.session
    act(saving.save_project, again)  # what it holds is known
    saved.write_text("damaged")
    act(saving.save_project, again)
    names = [saved.name, apart.name, "blobs-001-other-002.langsplat"]
    assert sorted(path.name for path in saved.parent.glob("*.langsplat")) == sorted(names)
    assert saved.with_name(names[-1]).read_text() == "damaged"


def test_a_project_of_one_window_is_saved_again(viewer, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "blobs.ply").touch()
    monkeypatch.chdir(tmp_path / "here")
    act(opening.open_file, viewer, Path("../blobs.ply"))
    path = saving.save_project(viewer, Path(".."))
    settings.pin_at(viewer, 0.5, 0.5)
    settings.write_note(viewer, viewer.state.session.notes[0], " as it  is typed ")
    act(saving.save_project, viewer)  # to the same file, which is of the same scene
    assert errors(viewer) == []
    assert "another window" not in viewer.state.messages[-1].text
    assert json.loads(path.read_text())["scene"] == "blobs.ply"


def test_places_in_files_are_in_the_world(opened, saved, again, monkeypatch, tmp_path):
    """A scene that is read about another origin is shown, noted and filmed where it was."""
    path, view = saving.save_path(opened, tmp_path), saving.save_view(opened, tmp_path)
    origin = np.array([2.0, 0.5, -1.0])
    monkeypatch.setitem(SCENES, "blobs.ply", place_scene(SCENES["blobs.ply"], origin=origin))
    act(opening.open_project, again, saved)
    before, after = opened.state, again.state
    np.testing.assert_array_equal(after.origin, origin)
    np.testing.assert_allclose(after.open.view.eye + origin, before.open.view.eye, atol=1e-9)
    np.testing.assert_allclose(means(again) + origin, means(opened), atol=1e-5)
    (note,), (was,) = after.session.notes, before.session.notes
    np.testing.assert_allclose(note.at + origin, was.at, atol=1e-9)
    viewpoint.load_path(again, path)
    files = saving.save_path(again, tmp_path), saving.save_view(again, tmp_path)
    keys = [read_flight(file).keyframes[0].pose.position for file in (path, files[0])]
    np.testing.assert_allclose(*keys, atol=1e-9)
    poses = [read_cameras(file)[0].world_to_camera for file in (view, files[1])]
    np.testing.assert_allclose(*poses, atol=1e-9)
    camera = options.chosen_camera(str(view), after.open.scene)
    np.testing.assert_allclose(camera.position + origin, before.open.view.eye, atol=1e-9)


def test_project_without_scene_or_window_is_refused(saved, opened, run_viewer):
    code, _, problems = run_viewer(str(saved), "--headless", "--out", "a.png")
    assert code == 2
    assert "project" in problems[0]
    Path("blobs.ply").unlink()
    opening.open_dropped(opened, [saved])
    assert "not there" in errors(opened)[-1]
    assert opened.state.open is not None


def test_project_of_a_changed_scene_restores_only_queries(saved, viewer, monkeypatch):
    monkeypatch.setitem(SCENES, "blobs.ply", SCENES["blobs.ply"].take(np.arange(240)))
    act(opening.open_project, viewer, saved)
    assert len(viewer.state.session.queries) == 4
    assert not viewer.state.marks.selected.any()
    assert any("has changed" in text for text in errors(viewer))
    before = saved.read_bytes()
    saving.save_project(viewer)  # what was left out is not lost
    assert saved.with_name("blobs-001-other-001.langsplat").read_bytes() == before


def test_project_is_kept_where_its_scene_returns_without_its_marks(saved, again):
    before = saved.read_bytes()
    act(opening.reload, again)
    assert not again.state.marks.selected.any()
    saving.save_project(again)
    assert saved.with_name("blobs-001-other-001.langsplat").read_bytes() == before


SAVED = Path(__file__).parent / "saved"  # files as version 1 wrote them


def test_project_of_version_1_opens_and_means_the_same(viewer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("blobs.ply").touch()
    path = tmp_path / "version1.langsplat"
    path.write_bytes((SAVED / path.name).read_bytes())
    settings.toggle_overlay(viewer, "grid")
    act(opening.open_file, viewer, path)
    assert errors(viewer) == [NO_GROUPS, NOT_COMPARED]
    state, session = viewer.state, viewer.state.session
    assert session.queries == (
        Query("mug"),
        Query("book", 0.6, 0, 1),
        Query("plant", shown_since=2),
        Query("mug or book", slot=1, shown_since=3),
    )
    assert (session.chosen, session.level) == ("mug or book", "whole")
    assert result(viewer).found
    assert session.picture == PictureConfig("relevancy", dim=0.7, heat_scale=(0.4, 0.9), colour_map="magma")
    assert (session.clip, session.overlays) == (Clip(0.5, 40.0), ("grid",))  # it says nothing of overlays
    assert marked(viewer) == ("book", "plant", "")
    moved = state.open.scene.gaussians.means - SCENES["blobs.ply"].gaussians.means
    np.testing.assert_allclose(moved[blob("plant")], np.tile([0.0, 1.0, 0.0], (120, 1)), atol=1e-6)
    assert session.notes == (Note('a "note" <b>of</b> 1987', (0.0, 0.0, 0.0)),)
    assert (session.ruler.length, session.things) == (1.0, Things({3: "the atlas"}))
    assert [(key.seconds, key.pose.span is None) for key in session.keyframes] == [(0.0, True), (2.0, False)]
    assert [bookmark.name for bookmark in session.bookmarks] == ["from the left"]
    np.testing.assert_allclose(state.open.view.eye, [-3.551118, -1.122909, -3.418507], atol=1e-5)
    assert state.preferences.panels == ("Search", "Notes")


def test_other_files_of_version_1_mean_the_same(tmp_path):
    first, second = read_flight(SAVED / "version1.path.json").keyframes
    np.testing.assert_allclose(first.pose.position, [-3.551118, -1.122909, -3.418507], atol=1e-5)
    np.testing.assert_allclose(first.pose.rotation[2], [0.702835, 0.222248, 0.675743], atol=1e-5)
    assert second.seconds == 2.0
    assert second.pose.span == pytest.approx(4.705585)
    write_project(tmp_path / "a.langsplat", read_project(SAVED / "version1.langsplat"), Path)
    assert read_project(tmp_path / "a.langsplat").version == 2
    assert load_preferences(SAVED) == Preferences(
        "light", 1.25, ("/scenes/blobs.ply",), ("Search", "Notes"), "viridis", ("things", "grid")
    )


# Damaged at random, opened, drawn, and gone through.


def session_files(name: str) -> Callable[[Path], list[bytes]]:
    """Return what makes files `name`, of this version and, moved to the folder, of version 1."""

    def samples(folder: Path) -> list[bytes]:
        with new_viewer() as made:
            open_scene(made, folder / "blobs.ply")
            viewpoint.add_bookmark(made)
            save_session(made, folder)
            viewpoint.move(made, lambda view: orbit(view, 0.4, 0.1))
            viewpoint.add_keyframe(made)
            saving.save_path(made, folder)
            save_preferences(folder, made.state.preferences)
        old = (SAVED / name.replace("blobs-001", "version1")).read_text()
        return [(folder / name).read_bytes(), old.replace("/scenes", str(folder)).encode()]

    return samples


def opened_again(path: Path) -> float:
    with new_viewer() as made:
        if path.name == "preferences.json":
            made.state.preferences = load_preferences(path.parent)
            settings.take_preferences(made)
        scene = path.with_name("blobs.ply")
        act(opening.open_file, made, path if path.suffix == ".langsplat" else scene)
        if path.name.endswith(".path.json"):
            viewpoint.load_path(made, path)
        if problems := set(errors(made)) - {NO_GROUPS, NOT_COMPARED}:
            raise InputError(max(problems, key=len))
        shown = [made.state.request((32, 24))]
        for bookmark in made.state.session.bookmarks:
            go(viewpoint.glide_to, made, viewpoint.bookmarked_view(bookmark, made.state.open.extent))
            shown.append(made.state.request((32, 24)))
        if made.state.session.keyframes:
            viewpoint.scrub(made, viewpoint.path_seconds(made) / 3)
            shown.append(made.state.request((32, 24)))
        for request in shown:
            render_image(request, "cpu")
    return 1.0


KINDS = {
    name: FileKind(name, session_files(name), opened_again, in_json, share=0.2)
    for name in ("blobs-001.langsplat", "blobs-001.path.json", "preferences.json")
}
test_a_few_mutants_are_read_or_refused, test_many_mutants_are_read_or_refused = few_and_many(KINDS)


def test_project_with_impossible_values_is_refused(saved):
    top = json.loads(saved.read_text())
    session = top["session"]
    # masks: not base64, not zlib, too few, a bomb, a number
    raw = (b"abc", zlib.compress(b"abc"), zlib.compress(bytes(50_000_000)))
    packed = [b64encode(content).decode() for content in raw]
    changes = [
        *({"marks": {"hidden": bits}} for bits in ("&&&", *packed, 7)),
        {"clip": {"near": 2.0, "far": 1.0}},
        {"picture": {"heat_scale": [0.9, 0.1]}},
        {"picture": {"dim": 7.0}},
        {"latent_level": 3},
        {"keyframes": session["keyframes"] * 2},
    ]
    broken = [{**top, "session": {**session, **change}} for change in changes]
    endless = {"width": 160, "height": float("inf"), "fx": 128, "fy": 128, "cx": 80, "cy": 60}
    others = {"intrinsics": endless}, {"view": None}, {"view": []}, {"version": 1}, {"gaussians": 10**12}
    broken += [{**top, **change} for change in others]
    for content in ({"format": "other"}, [], *broken):
        saved.write_text(json.dumps(content))
        with pytest.raises(FormatError, match=r"no project .*; save it anew"):
            read_project(saved)


def test_another_version_is_named_with_what_helps(saved):
    saved.write_text(json.dumps(json.loads(saved.read_text()) | {"langsplat_flight": 2, "version": 3}))
    with pytest.raises(FormatError, match="version 3; this program reads 1 and 2; update it"):
        read_project(saved)
    with pytest.raises(FormatError, match="version 2; this program reads 1; update it"):
        read_flight(saved)


def test_a_fault_of_the_program_is_no_fault_of_the_file(saved, monkeypatch):
    monkeypatch.setattr(projects, "checked", lambda session: session.nothing)
    with pytest.raises(AttributeError):
        read_project(saved)


def test_a_linked_project_names_its_scene_from_its_own_folder(opened, tmp_path):
    own, link = tmp_path / "own" / "a.langsplat", tmp_path / "links" / "a.langsplat"
    own.parent.mkdir()
    link.parent.mkdir()
    link.symlink_to(own)
    project = read_project(saving.save_project(opened, own))
    for scene in (own.with_suffix(".ply"), link.with_suffix(".ply")):
        project.scene = str(scene)
        write_project(link, project, lambda: tmp_path / "before.langsplat")
        assert (read_project(link).scene, read_project(own).scene) == (str(scene), str(scene))


def test_notes_are_pinned_edited_and_removed(opened):
    settings.toggle_pinning(opened)
    settings.pin_at(opened, 0.95, 0.5)  # nothing is there
    assert opened.state.session.notes == ()
    assert opened.state.pins_notes
    settings.pin_at(opened, 0.5, 0.5)
    assert not opened.state.pins_notes
    (note,) = opened.state.session.notes
    settings.write_note(opened, note, "x" * 9000)
    assert len(opened.state.session.notes[0].text) == 500
    settings.escape(opened)
    settings.take_off(opened, "notes", opened.state.session.notes[0])
    assert opened.state.session.notes == ()
    editing.undo(opened)
    assert [len(note.text) for note in opened.state.session.notes] == [500]
    editing.undo(opened)
    assert opened.state.session.notes == (note,)
    editing.redo(opened)
    editing.redo(opened)
    assert opened.state.session.notes == ()


@pytest.mark.parametrize("leave", [saving.save_project_and_leave, saving.end])
def test_unsaved_notes_are_asked_about_before_closing(opened, tmp_path, leave, capsys):
    """Keyframes, too, and those of a scene that was left; the terminal names the file."""
    settings.pin_at(opened, 0.5, 0.5)
    assert not saving.may_close(opened)
    settings.escape(opened)
    editing.undo(opened)
    assert saving.may_close(opened)
    opened.state.may_close = False
    viewpoint.add_keyframe(opened)
    open_scene(opened, "plain.ply")
    assert not opened.state.is_changed
    assert not saving.may_close(opened)
    leave(opened, tmp_path)
    assert opened.state.may_close
    assert len(read_project(tmp_path / "blobs-001.langsplat").session.keyframes) == 1
    assert "blobs-001.langsplat" in capsys.readouterr().err
    assert saving.may_close(opened)


def test_first_save_asks_for_a_file_and_the_next_do_not(opened, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings.pin_at(opened, 0.5, 0.5)
    saving.save(opened)
    assert opened.state.choice.start == tmp_path / "blobs-001.langsplat"
    settings.choose(opened, "mine")
    assert (opened.state.saved.project, opened.state.is_changed) == (tmp_path / "mine.langsplat", False)
    settings.pin_at(opened, 0.4, 0.4)
    assert opened.state.is_changed
    saving.save(opened)
    assert (opened.state.choice, opened.state.is_changed) == (None, False)
    saving.save_as(opened)
    settings.choose(opened, "mine.langsplat")
    assert "is there already" in errors(opened)[-1]
    settings.choose(opened, "other.langsplat")
    for name in ("mine", "other"):
        assert read_project(tmp_path / f"{name}.langsplat").session.notes == opened.state.session.notes


def test_notes_return_with_their_scene(opened):
    settings.pin_at(opened, 0.5, 0.5)
    notes = opened.state.session.notes
    opening.add_scenes(opened, [Path("blobs.ply"), Path("plain.ply")])
    for step, there in ((1, ()), (-1, notes)):
        act(opening.step_scene, opened, step)
        assert opened.state.session.notes == there
    act(opening.reload, opened)
    assert opened.state.session.notes == notes
    assert opened.state.is_changed
