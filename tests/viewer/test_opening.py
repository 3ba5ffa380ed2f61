"""Opening scenes, without a window."""

import os
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Scene
from langsplat_viewer.actions import opening, queries, settings, viewpoint
from langsplat_viewer.camera.controls import orbit
from langsplat_viewer.disk import path_completions
from langsplat_viewer.rendering.request import UNCLIPPED, Clip
from tests.support.fakes import blob_scene
from tests.support.windowless import SCENES, act, ask, errors, go, open_scene, result, settle


def test_opening_counts_unusable_gaussians(viewer):
    scene = blob_scene(field=False)
    scene.gaussians.means[[3, 7]] = np.nan
    viewer.services = replace(viewer.services, load_scene=lambda path: scene)
    open_scene(viewer, "holes.ply")
    assert viewer.state.messages[0].text == "holes.ply: 360 Gaussians; not drawn: 2 with position not finite"
    assert np.isfinite(viewer.state.open.view.camera(160, 120).world_to_camera).all()


def test_broken_file_leaves_the_open_scene(opened):
    before = opened.state.open.view
    open_scene(opened, "broken.ply")
    assert opened.state.open.scene is SCENES["blobs.ply"]
    assert (opened.state.open.view, opened.state.opening) == (before, None)
    assert errors(opened) == ["broken.ply: broken; export it again"]


def test_scene_without_field_says_what_makes_one(viewer):
    settings.set_display(viewer, "relevancy")
    open_scene(viewer, "plain.ply")
    assert viewer.state.session.picture.display == "rgb"
    assert "langsplat train" in viewer.state.messages[-1].text
    queries.ask(viewer, "")  # nothing, as a command line without --query
    assert errors(viewer) == []
    queries.ask(viewer, "mug")
    settings.set_display(viewer, "latent")
    assert (viewer.state.session.queries, viewer.state.session.picture.display) == ((), "rgb")
    assert "langsplat train" in errors(viewer)[-1]


def test_cancelled_opening_shows_nothing(viewer):
    release = threading.Event()

    def slow(path: Path) -> Scene:
        assert release.wait(10)
        return SCENES["blobs.ply"]

    viewer.services = replace(viewer.services, load_scene=slow)
    opening.open_scene(viewer, Path("blobs.ply"))
    queries.focus_search(viewer)
    assert errors(viewer) == ["blobs.ply is being opened: wait for it, then search it"]
    opening.cancel(viewer)
    assert (viewer.worker.current, viewer.state.opening) == (None, None)
    release.set()
    viewer.worker.submit("after it", lambda progress: None, lambda nothing: None, pytest.fail)
    settle(viewer)
    assert viewer.state.open is None


@pytest.mark.parametrize(
    ("names", "opened_name", "said"),
    [
        (["notes.txt", "plain.ply"], "plain.ply", "not opened: notes.txt"),
        (["blobs.cameras.json", "blobs.langsplat.safetensors", "blobs.ply"], "blobs.ply", ""),
        (["blobs.ply", *"abcde"], "blobs.ply", "not opened: a and 4 more"),
    ],
)
def test_dropping_opens_the_scene_and_names_other_files(viewer, names, opened_name, said):
    act(opening.open_dropped, viewer, [Path(name) for name in names])
    assert viewer.state.path.name == opened_name
    assert [path.name for path in viewer.state.scenes] == [opened_name]
    assert errors(viewer) == ([said] if said else [])
    act(opening.open_dropped, viewer, [Path("notes.txt")])
    assert [path.name for path in viewer.state.scenes] == [opened_name]


# Several scenes to switch between, without a window.

BLOBS, PLAIN, BARE = (Path(f"{name}.ply").absolute() for name in ("blobs", "plain", "bare"))


@pytest.fixture
def three(viewer):
    """Three scenes were dropped; the first is shown."""
    act(opening.open_dropped, viewer, [Path("blobs.ply"), Path("plain.ply"), Path("bare.ply")])
    return viewer


def test_display_returns_with_its_scene_and_visits_keep_no_arrays(three):
    ask(three, "mug")
    act(opening.switch_scene, three, PLAIN)
    assert three.state.session.picture.display == "rgb"
    (visit,) = three.visits.values()
    assert not any(isinstance(value, np.ndarray) and value.size > 16 for value in vars(visit).values())
    act(opening.switch_scene, three, BLOBS)
    assert three.state.session.picture.display == "relevancy"
    opening.unlist_scene(three, PLAIN)
    assert (three.state.scenes, PLAIN in three.visits) == ((BLOBS, BARE), False)


def test_scene_returns_with_its_camera_and_queries(three):
    assert (three.state.open.scene, three.state.scenes) == (SCENES["blobs.ply"], (BLOBS, PLAIN, BARE))
    assert settings.take(three.state, "wanted_panel") == "Scene"
    ask(three, "mug", "book")
    queries.show(three, "mug", shown=False)
    queries.set_cut(three, "book", 0.7)
    go(viewpoint.go_to_camera, three, 2)
    settings.set_clip(three, Clip(1.0, 9.0))
    viewpoint.add_keyframe(three)
    view = three.state.open.view
    act(opening.switch_scene, three, BARE)
    assert three.state.open.scene is SCENES["bare.ply"]
    assert three.state.session.queries == ()
    assert three.state.session.clip == UNCLIPPED
    ask(three, "plant")
    viewpoint.zoom_by(three, 2.0)
    bare = three.state.open.view

    act(opening.switch_scene, three, BLOBS)
    state = three.state
    assert state.open.view is view
    listed = [(query.phrase, query.slot, query.cut) for query in state.session.queries]
    assert listed == [("mug", None, None), ("book", 1, 0.7)]
    assert result(three, 1).own_cut == 0.7
    assert (state.camera_index, len(state.session.keyframes)) == (2, 1)
    assert state.session.clip == Clip(1.0, 9.0)
    act(opening.switch_scene, three, BARE)
    assert three.state.open.view is bare
    assert errors(three) == []
    assert [query.phrase for query in three.state.session.queries] == ["plant"]
    assert three.state.shown_results()[0].found


# Files and folders that are asked for, without a window.


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: scenes, folders, and what is neither."""
    monkeypatch.chdir(tmp_path)
    for name in ("a.ply", "A.SPZ", "about.txt", ".a.ply"):
        (tmp_path / name).write_bytes(b"12345")
    (tmp_path / "all").mkdir()
    return tmp_path


def test_typed_path_is_completed_by_folders_and_scenes(folder):
    kinds = (".ply", ".spz")
    above, *offered = path_completions("", folder, kinds)
    assert (above, offered) == (f"{folder.parent}/", [f"{folder}/{n}" for n in ("A.SPZ", "a.ply", "all/")])
    assert path_completions("all/../a.", folder, kinds)[1:] == [f"{folder}/all/../a.ply"]
    assert path_completions(f"{folder}/al", Path("/gone"), kinds) == [f"{folder}/", f"{folder}/all/"]
    assert path_completions("/", folder, kinds)[0] == "/"
    for typed in ("b", "gone/", "a.ply/", "[a]", "x" * 5000):
        assert path_completions(typed, folder, kinds)[1:] == []


@pytest.mark.parametrize("typed", [" blobs.ply ", "all/../blobs.ply"])
def test_chosen_path_is_opened(viewer, folder, typed):
    opening.ask_for_file(viewer)
    act(settings.choose, viewer, "  ")
    assert viewer.state.choice.start == folder
    act(settings.choose, viewer, typed)
    assert viewer.state.open.scene is SCENES["blobs.ply"]
    assert viewer.state.choice is None
    opening.ask_for_file(viewer)
    settings.escape(viewer)
    assert viewer.state.choice is None
    for absent in ("gone.ply", "x" * 5000, "~nobody-of-this-name/a.ply"):
        before = len(errors(viewer))
        opening.ask_for_file(viewer)
        act(settings.choose, viewer, absent)
        assert len(errors(viewer)) == before + 1


# The shown scene's files change on disk, without a window.


@pytest.fixture
def shown(viewer, tmp_path):
    """Shows a scene of three blobs that lies on disk."""
    path = tmp_path / "blobs.ply"
    save_scene(path, replace(blob_scene(), path=None))
    viewer.services = replace(viewer.services, load_scene=load_scene)
    open_scene(viewer, path)
    return viewer


def look(viewer) -> bool:
    """As long as it takes to notice a change that is over."""
    viewer.watch.look()
    viewer.watch.look()
    return viewer.watch.changed


FILES = ["blobs.ply", "blobs.langsplat.safetensors", "blobs.cameras.json"]


@pytest.mark.parametrize("name", FILES)
def test_watch_reports_a_finished_change_of_any_file(shown, name):
    file, woken = shown.state.path.with_name(name), []
    shown.watch.wake = lambda: woken.append(name)
    for second in range(3):  # it is being written
        os.utime(file, ns=(second, second))
        shown.watch.look()
        assert not shown.watch.changed
    assert look(shown)
    assert woken == [name]
    shown.watch.dismiss()
    assert not look(shown)
    os.utime(file, ns=(9, 9))  # it changes again
    assert look(shown)


def test_watch_reports_companions_but_no_missing_scene(shown):
    sidecar = shown.state.path.with_name(FILES[1])
    kept = sidecar.rename(sidecar.with_name("kept"))
    assert look(shown)
    kept.rename(sidecar)
    assert not look(shown)  # as it was read
    shown.state.path.unlink()
    assert not look(shown)


def test_reload_keeps_camera_queries_and_settings(shown):
    ask(shown, "mug", "book")
    queries.set_cut(shown, "mug", 0.6)
    queries.show(shown, "book", shown=False)
    shown.put(chosen="mug")
    viewpoint.go_to_camera(shown, 1)
    viewpoint.tick(shown, shown.clock + 10)
    viewpoint.add_keyframe(shown)
    shown.change(splats=replace(shown.state.session.splats, size=0.5))
    settings.set_picture(shown, replace(shown.state.session.picture, dim=0.1))
    view, before = shown.state.open.view, shown.state.open.scene
    dyed = replace(before.gaussians, sh=-before.gaussians.sh)
    save_scene(shown.state.path, replace(before, gaussians=dyed, cameras=before.cameras[:2], path=None))
    assert look(shown)
    act(opening.reload, shown)
    state = shown.state
    assert state.open.scene is not before
    np.testing.assert_array_equal(state.open.scene.gaussians.sh, dyed.sh)
    assert state.open.view is view
    session = state.session
    listed = [(query.phrase, query.slot, query.cut) for query in session.queries]
    assert listed == [("mug", 0, 0.6), ("book", None, None)]
    assert result(shown, 0).own_cut == 0.6
    assert (session.picture.display, session.picture.dim, session.splats.size) == ("relevancy", 0.1, 0.5)
    assert (session.chosen, len(session.keyframes), state.camera_index) == ("mug", 1, 1)
    assert not look(shown)
    assert errors(shown) == []


def test_reload_follows_other_gaussians_and_a_missing_field(shown):
    ask(shown, "plant")
    save_scene(shown.state.path, replace(blob_scene().take(np.arange(0, 360, 2)), path=None))
    act(opening.reload, shown)
    assert result(shown).members.shape == (180,)
    assert shown.state.marks.selected.shape == (180,)
    save_scene(shown.state.path, replace(blob_scene(field=False), path=None))
    act(opening.reload, shown)
    assert (shown.state.session.picture.display, shown.state.session.queries) == ("rgb", ())


@pytest.mark.parametrize("name", FILES)
def test_half_written_file_leaves_the_scene(shown, name):
    ask(shown, "mug")
    before, view, found = shown.state.open.scene, shown.state.open.view, result(shown)
    file = shown.state.path.with_name(name)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert look(shown)
    act(opening.reload, shown)
    assert shown.state.open.scene is before
    assert (shown.state.open.view, result(shown)) == (view, found)
    assert name in errors(shown)[-1]
    assert shown.watch.changed  # to be tried again
    file.write_bytes(whole)
    act(opening.reload, shown)
    assert shown.state.open.scene is not before
    assert not look(shown)


# A second scene beside the first: seen and asked alike, and gone when it is not shown any more.


@pytest.fixture
def two(opened):
    """The blobs, and beside them the same with a phrasebook."""
    ask(opened, "mug")
    opening.open_beside(opened, Path("book.ply"))
    meet(opened)
    yield opened
    if opened.beside is not None:
        opened.beside.worker.close()


def meet(viewer) -> None:
    """Frames until both have done what there is to do."""
    for _ in range(3):
        act(opening.follow_beside, viewer)
        if viewer.beside is not None:
            settle(viewer.beside)
    opening.follow_beside(viewer)


def test_second_scene_follows_view_and_queries(two):
    other = two.beside.state
    assert other.path == Path("book.ply")
    assert [(query.phrase, query.slot) for query in other.session.queries] == [("mug", 0)]
    assert result(two.beside).found
    assert other.open.view is two.state.open.view
    two.put(adds=True)
    for phrase in ("book", "nothing like this"):
        queries.ask(two, phrase)
    queries.set_level(two, "whole")
    settings.set_display(two, "segmentation")
    settings.resize(two, 77, 55)
    act(viewpoint.move, two, lambda view: orbit(view, 0.2, 0.1))
    meet(two)
    assert {query.phrase: query.slot for query in other.session.queries} == {"mug": 0, "book": 1}
    seen = other.session.level, other.session.picture.display, other.size
    assert seen == ("whole", "segmentation", (77, 55))
    assert other.open.view is two.state.open.view
    queries.show(two, "mug", shown=False)
    queries.remove(two, "book")
    meet(two)
    assert [(query.phrase, query.slot) for query in other.session.queries] == [("mug", None)]


def test_second_scene_without_field_shows_colours_or_says_why(two):
    for name in ("plain.ply", "broken.ply"):
        assert errors(two) == []
        opening.open_beside(two, Path(name))
        meet(two)
        if name == "plain.ply":
            assert (two.beside.state.session.picture.display, two.beside.state.session.queries) == ("rgb", ())
    assert "broken.ply" in errors(two)[-1]
    assert two.state.open is not None
    two.beside = None  # as where a project is opened that compared them
    meet(two)
    assert two.state.session.split.mode == "off"
    assert "choose it in Compare with" in two.state.messages[-1].text


@pytest.mark.parametrize("away", [(-90, 0, 0), (90, 0, 0)])
def test_opening_view_shows_a_compared_scene_far_away(two, monkeypatch, away):
    """Each scene on its side of the line; a near one leaves the opening view as it is."""
    go(viewpoint.reset_view, two)
    blobs, state = SCENES["blobs.ply"], two.state
    home = viewpoint.opening_view(state.open, state.size)
    np.testing.assert_array_equal(state.open.view.eye, home.eye)
    there = (blobs.gaussians.means + away).astype(np.float32)
    monkeypatch.setitem(SCENES, "far.ply", replace(blobs, gaussians=replace(blobs.gaussians, means=there)))
    opening.open_beside(two, Path("far.ply"))
    meet(two)
    for show in (viewpoint.reset_view, viewpoint.frame_scene):
        go(show, two)
        camera = state.open.view.camera(*state.size)
        for means, is_right in ((blobs.gaussians.means, False), (there, True)):
            pixels, depths = camera.project(means.astype(np.float64))
            assert camera.in_image(pixels, depths).all()
            assert ((pixels[:, 0] > camera.width / 2) == is_right).all()
