"""Opening scenes, without a window."""

import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Scene
from langsplat_viewer.actions import browsing, filming, opening, queries, settings, viewpoint
from langsplat_viewer.files.disk import MOST_LISTED, Entry, Watch, list_folder, stamps
from langsplat_viewer.options import say_compiling
from langsplat_viewer.panels.scene import has_several
from langsplat_viewer.rendering.request import UNCLIPPED, Clip
from tests.support.fakes import blob_scene
from tests.support.windowless import SCENES, arrive, ask, errors, open_scene, settle


def test_unusable_gaussians_are_counted(viewer):
    scene = blob_scene(field=False)
    scene.gaussians.means[[3, 7]] = np.nan
    viewer.services = replace(viewer.services, load_scene=lambda path: scene)
    open_scene(viewer, "holes.ply")
    assert viewer.state.messages[0].text == "holes.ply: 360 Gaussians; not drawn: 2 with position not finite"
    assert np.isfinite(viewer.state.view.camera(160, 120).world_to_camera).all()


def test_a_broken_file_leaves_the_open_scene_alone(opened):
    before = opened.state.view
    open_scene(opened, "broken.ply")
    assert opened.state.scene is SCENES["blobs.ply"]
    assert opened.state.view is before
    assert opened.state.opening is None
    assert errors(opened) == ["broken.ply: broken; export it again"]


def test_a_scene_without_language_field_says_what_makes_one(viewer):
    settings.set_display(viewer, "relevancy")
    open_scene(viewer, "plain.ply")
    assert viewer.state.picture.display == "rgb"
    assert "langsplat train" in viewer.state.messages[-1].text
    queries.ask(viewer, "mug")
    settings.set_display(viewer, "latent")
    assert viewer.state.queries == []
    assert viewer.state.picture.display == "rgb"
    assert "langsplat train" in errors(viewer)[-1]


def test_cancelled_opening_shows_nothing(viewer):
    release = threading.Event()

    def slow(path: Path) -> Scene:
        assert release.wait(10)
        return SCENES["blobs.ply"]

    viewer.services = replace(viewer.services, load_scene=slow)
    opening.open_scene(viewer, Path("blobs.ply"))
    opening.cancel(viewer)
    assert viewer.worker.current is None
    assert viewer.state.opening is None
    release.set()
    viewer.worker.submit("after it", lambda progress: None, lambda nothing: None, pytest.fail)
    settle(viewer)
    assert viewer.state.scene is None


def test_a_scene_with_broken_companions_opens_and_says_why(tmp_path, viewer):
    path = tmp_path / "a.ply"
    save_scene(path, replace(blob_scene(), path=None))
    names = ("a.cameras.json", "a.langsplat.safetensors")
    for name in names:
        (tmp_path / name).write_bytes(b"{")
    viewer.services = replace(viewer.services, load_scene=load_scene)
    open_scene(viewer, path)
    assert viewer.state.scene.language is None
    said = errors(viewer)
    assert len(said) == 2
    assert all(name in reason for name, reason in zip(names, said, strict=True))


@pytest.mark.parametrize(
    ("names", "opened_name", "said"),
    [
        (["notes.txt", "plain.ply"], "plain.ply", "not opened: notes.txt"),
        (["blobs.cameras.json", "blobs.langsplat.safetensors", "blobs.ply"], "blobs.ply", ""),
        (["blobs.ply", *"abcde"], "blobs.ply", "not opened: a, b, c and 2 more"),
    ],
)
def test_of_dropped_files_the_scene_is_opened_and_what_is_none_is_said(viewer, names, opened_name, said):
    browsing.open_dropped(viewer, [Path(name) for name in names])
    settle(viewer)
    assert viewer.state.path.name == opened_name
    assert [path.name for path in viewer.state.scenes] == [opened_name]
    assert errors(viewer) == ([said] if said else [])


# Several scenes to switch between, without a window.

BLOBS, PLAIN, BARE = (Path(f"{name}.ply").absolute() for name in ("blobs", "plain", "bare"))


def test_the_first_run_says_that_it_compiles(viewer, monkeypatch):
    seen = []

    def warm_up(scene, backend, progress):
        say_compiling(progress)
        seen.append(viewer.worker.current)

    monkeypatch.setattr("langsplat_core.compiled.is_compiled", lambda source: False)
    monkeypatch.setattr("langsplat_viewer.actions.opening.is_compiled", lambda source: False)
    viewer.services = replace(viewer.services, warm_up=warm_up)
    labels, submit = [], viewer.worker.submit
    monkeypatch.setattr(
        viewer.worker, "submit", lambda label, *rest: labels.append(label) or submit(label, *rest)
    )
    open_scene(viewer, "blobs.ply")
    assert seen == [("compiling the drawing kernels, once per installation (half a minute)", 0.7)]
    assert "compiling the search kernels, once per installation (half a minute)" in labels
    assert errors(viewer) == []


@pytest.fixture
def three(viewer):
    """Three scenes were dropped; the first is shown."""
    browsing.open_dropped(viewer, [Path("blobs.ply"), Path("plain.ply"), Path("bare.ply")])
    settle(viewer)
    return viewer


def switch(viewer, path: Path) -> None:
    opening.switch_scene(viewer, path)
    settle(viewer)


def test_of_several_the_first_is_opened_and_all_are_listed(three):
    assert three.state.scene is SCENES["blobs.ply"]
    assert three.state.scenes == (BLOBS, PLAIN, BARE)
    assert errors(three) == []
    assert settings.take_wanted_panel(three) == "Scene"


def test_camera_and_queries_of_each_are_found_again(three):
    ask(three, "mug", "book")
    queries.set_canonical(three, "plant")
    settle(three)
    mug, book = three.state.queries
    queries.hide(three, mug)
    queries.set_cut(three, book, 0.7)
    viewpoint.go_to_camera(three, 2)
    arrive(three)
    settings.set_clip(three, Clip(1.0, 9.0))
    filming.add_keyframe(three)
    view = three.state.view
    switch(three, BARE)
    assert three.state.scene is SCENES["bare.ply"]
    assert three.state.queries == []
    assert three.state.canonical == ()
    assert three.state.settings.clip == UNCLIPPED
    ask(three, "plant")
    viewpoint.zoom_by(three, 2.0)
    bare = three.state.view

    switch(three, BLOBS)
    state = three.state
    assert state.view is view
    assert [(q.phrase, q.slot, q.cut) for q in state.queries] == [("mug", None, None), ("book", 1, 0.7)]
    assert state.queries[1].result.own_cut == 0.7
    assert state.canonical == three.engine.canonical_phrases == ("plant",)
    assert (state.camera_index, len(state.record.keyframes)) == (2, 1)
    assert state.settings.clip == Clip(1.0, 9.0)
    switch(three, BARE)
    assert three.state.view is bare
    assert [query.phrase for query in three.state.queries] == ["plant"]
    assert three.state.shown_results()[0].found
    assert three.engine.canonical_phrases != ("plant",)


def test_a_display_of_answers_comes_back_after_a_scene_without(three):
    ask(three, "mug")
    switch(three, PLAIN)
    assert three.state.picture.display == "rgb"
    switch(three, BLOBS)
    assert three.state.picture.display == "relevancy"


def test_nothing_of_a_scene_that_was_left_is_kept_in_memory(three):
    ask(three, "mug")
    switch(three, BARE)
    (visit,) = three.visits.values()
    assert [query.result for query in visit.queries] == [None]
    assert not any(isinstance(value, np.ndarray) and value.size > 16 for value in vars(visit).values())


def test_a_scene_is_taken_off_the_list(three):
    switch(three, PLAIN)
    opening.unlist_scene(three, BLOBS)
    assert three.state.scenes == (PLAIN, BARE)
    assert three.visits == {}
    opening.step_scene(three, 1)
    settle(three)
    assert three.state.path == BARE


def test_all_scenes_of_a_folder_are_opened_together(viewer, tmp_path):
    for name in ("blobs.ply", "plain.ply", "a.queries.json"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder").mkdir()
    viewer.state.browser = list_folder(tmp_path)
    assert has_several(viewer.state.browser)
    browsing.open_all(viewer)
    settle(viewer)
    assert viewer.state.browser is None
    assert viewer.state.scenes == (tmp_path / "blobs.ply", tmp_path / "plain.ply")
    assert viewer.state.path.name == "blobs.ply"
    (tmp_path / "plain.ply").unlink()
    assert not has_several(list_folder(tmp_path))


# The file browser, without a window.


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Scenes, folders, and what is neither."""
    (tmp_path / "B folder").mkdir()
    (tmp_path / "sog folder").mkdir()
    (tmp_path / "sog folder" / "meta.json").write_text("{}")
    for name in ("a.ply", "Z.SPZ", "notes.txt", ".hidden.ply"):
        (tmp_path / name).write_bytes(b"12345")
    return tmp_path


def test_folders_come_first_and_what_is_no_scene_is_left_out(folder):
    listing = list_folder(folder)
    listed = [(entry.path.name, entry.is_file, entry.size) for entry in listing.entries]
    assert listed == [
        ("B folder", False, 0),
        ("a.ply", True, 5),
        ("sog folder", True, 0),
        ("Z.SPZ", True, 5),
    ]
    assert not listing.problem


def test_a_folder_that_cannot_be_listed_says_why(tmp_path):
    assert "No such file" in list_folder(tmp_path / "gone").problem
    assert "Not a directory" in list_folder(_file(tmp_path)).problem


def _file(folder: Path) -> Path:
    path = folder / "file"
    path.write_bytes(b"")
    return path


def test_a_crowded_folder_is_cut(tmp_path, monkeypatch):
    monkeypatch.setattr("langsplat_viewer.files.disk.MOST_LISTED", 3)
    for number in range(5):
        (tmp_path / f"{number}.ply").write_bytes(b"")
    listing = list_folder(tmp_path)
    assert (len(listing.entries), listing.left_out) == (3, 2)
    assert MOST_LISTED > 100


def test_one_goes_into_folders_and_opens_scenes(viewer, folder, monkeypatch):
    monkeypatch.chdir(folder)
    browsing.ask_for_file(viewer)
    assert viewer.state.browser.folder == folder
    browsing.choose(viewer, Entry(folder / "B folder", is_file=False))
    assert viewer.state.browser.folder == folder / "B folder"
    browsing.browse(viewer, folder)
    browsing.choose(viewer, Entry(folder / "blobs.ply", is_file=True))
    assert viewer.state.browser is None
    settle(viewer)
    assert viewer.state.scene is SCENES["blobs.ply"]
    browsing.ask_for_file(viewer)
    assert viewer.state.browser.folder == folder  # that of the scene
    settings.escape(viewer)
    assert viewer.state.browser is None


@pytest.mark.parametrize("typed", [" blobs.ply ", "B folder/../blobs.ply"])
def test_a_path_can_be_typed(viewer, folder, monkeypatch, typed):
    monkeypatch.chdir(folder)
    browsing.ask_for_file(viewer)
    for nothing in ("", "  "):
        viewer.state.path_typed = nothing
        browsing.open_typed(viewer)
        assert viewer.state.browser is not None
    viewer.state.path_typed = "B folder"
    browsing.open_typed(viewer)
    assert viewer.state.browser.folder == folder / "B folder"
    assert viewer.state.path_typed == ""
    browsing.browse(viewer, folder)
    viewer.state.path_typed = typed
    browsing.open_typed(viewer)
    settle(viewer)
    assert viewer.state.scene is SCENES["blobs.ply"]


@pytest.mark.parametrize("typed", ["gone.ply", "x" * 5000, "~nobody-of-this-name/a.ply"])
def test_a_path_that_leads_nowhere_is_an_error_line(viewer, folder, monkeypatch, typed):
    monkeypatch.chdir(folder)
    browsing.ask_for_file(viewer)
    viewer.state.path_typed = typed
    browsing.open_typed(viewer)
    settle(viewer)
    assert len(errors(viewer)) == 1


def test_scenes_that_were_open_are_remembered_the_latest_first(viewer):
    for name in ("blobs.ply", "plain.ply", "blobs.ply"):
        open_scene(viewer, name)
    recent = viewer.state.preferences.recent
    assert [Path(path).name for path in recent] == ["blobs.ply", "plain.ply"]
    assert all(Path(path).is_absolute() for path in recent)
    browsing.open_recent(viewer, recent[1])
    settle(viewer)
    assert viewer.state.scene is SCENES["plain.ply"]


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


def dyed() -> object:
    """The same scene in other colours and with fewer cameras."""
    scene = replace(blob_scene(), path=None)
    gaussians = replace(scene.gaussians, sh=-scene.gaussians.sh)
    return replace(scene, gaussians=gaussians, cameras=scene.cameras[:2])


@pytest.mark.parametrize("name", ["blobs.ply", "blobs.langsplat.safetensors", "blobs.cameras.json"])
def test_a_change_of_any_file_is_noticed_once_it_is_over(shown, name):
    file, woken = shown.state.path.with_name(name), []
    shown.watch.wake = lambda: woken.append(name)
    for second in range(3):  # it is being written
        os.utime(file, ns=(second, second))
        shown.watch.look()
        assert not shown.watch.changed
    shown.watch.look()
    assert shown.watch.changed
    shown.watch.look()
    assert woken == [name]


def test_a_companion_that_was_added_or_taken_away_is_a_change(shown):
    sidecar = shown.state.path.with_name("blobs.langsplat.safetensors")
    kept = sidecar.with_name("kept")
    shutil.move(sidecar, kept)
    assert look(shown)
    shutil.move(kept, sidecar)
    assert not look(shown)  # as it was read


def test_a_scene_whose_file_is_gone_is_not_offered(shown):
    shown.state.path.unlink()
    assert not look(shown)


def test_reload_keeps_camera_queries_and_settings(shown):
    ask(shown, "mug", "book")
    mug, book = shown.state.queries
    queries.set_cut(shown, mug, 0.6)
    queries.hide(shown, book)
    queries.select(shown, mug)
    viewpoint.go_to_camera(shown, 1)
    viewpoint.tick(shown, shown.clock + 10)
    filming.add_keyframe(shown)
    settings.set_splats(shown, replace(shown.state.settings.splats, size=0.5))
    settings.set_picture(shown, replace(shown.state.picture, dim=0.1))
    view, before = shown.state.view, shown.state.scene
    save_scene(shown.state.path, dyed())
    assert look(shown)
    opening.reload(shown)
    settle(shown)
    state = shown.state
    assert state.scene is not before
    np.testing.assert_array_equal(state.scene.gaussians.sh, dyed().gaussians.sh.astype(np.float32))
    assert state.view is view
    assert [(q.phrase, q.slot, q.cut) for q in state.queries] == [("mug", 0, 0.6), ("book", None, None)]
    assert state.queries[0].result.own_cut == 0.6
    assert state.selected is state.queries[0]
    assert (state.picture.display, state.picture.dim, state.settings.splats.size) == ("relevancy", 0.1, 0.5)
    assert len(state.record.keyframes) == 1
    assert state.camera_index == 1
    assert not look(shown)
    assert errors(shown) == []


def test_a_reload_with_other_gaussians_asks_anew(shown):
    ask(shown, "plant")
    half = np.arange(0, 360, 2)
    save_scene(shown.state.path, replace(blob_scene().take(half), path=None))
    opening.reload(shown)
    settle(shown)
    (query,) = shown.state.queries
    assert query.result.members.shape == (180,)
    assert shown.state.selection.marks.selected.shape == (180,)


@pytest.mark.parametrize("name", ["blobs.ply", "blobs.langsplat.safetensors", "blobs.cameras.json"])
def test_a_half_written_file_leaves_the_scene_as_it_was(shown, name):
    ask(shown, "mug")
    query, before, view = shown.state.queries[0], shown.state.scene, shown.state.view
    answer = query.result
    file = shown.state.path.with_name(name)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    assert look(shown)
    opening.reload(shown)
    settle(shown)
    assert shown.state.scene is before
    assert (shown.state.view, shown.state.queries, query.result) == (view, [query], answer)
    assert name in errors(shown)[-1]
    assert shown.watch.changed  # to be tried again
    file.write_bytes(whole)
    opening.reload(shown)
    settle(shown)
    assert shown.state.scene is not before
    assert not look(shown)


def test_what_is_not_wanted_is_not_offered_again_until_it_changes_again(shown):
    os.utime(shown.state.path, ns=(1, 1))
    assert look(shown)
    shown.watch.dismiss()
    assert not look(shown)
    os.utime(shown.state.path, ns=(2, 2))
    assert look(shown)


def test_a_field_that_went_away_takes_its_display_along(shown):
    ask(shown, "mug")
    save_scene(shown.state.path, replace(blob_scene(field=False), path=None))
    opening.reload(shown)
    settle(shown)
    assert shown.state.picture.display == "rgb"
    assert shown.state.queries == []


def test_a_watch_looks_by_itself_and_stops(tmp_path, monkeypatch):
    monkeypatch.setattr("langsplat_viewer.files.disk.EVERY", 0.005)
    file: Path = tmp_path / "a.ply"
    file.write_bytes(b"a")
    woken = threading.Event()
    watch = Watch(woken.set)
    watch.begin(stamps((file,)))
    watch.start()
    file.write_bytes(b"longer")
    assert woken.wait(5)
    assert watch.changed
    watch.close()
