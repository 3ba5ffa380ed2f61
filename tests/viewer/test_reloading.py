"""The shown scene's files change on disk, without a window."""

import os
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io import load_scene, save_scene
from langsplat_viewer.actions import filming, opening, queries, settings, viewpoint
from langsplat_viewer.files.watching import Watch, stamps
from tests.support.fakes import blob_scene
from tests.support.windowless import errors, settle


@pytest.fixture
def shown(viewer, tmp_path):
    """Shows a scene of three blobs that lies on disk."""
    path = tmp_path / "blobs.ply"
    save_scene(path, replace(blob_scene(), path=None))
    viewer.services = replace(viewer.services, load_scene=load_scene)
    opening.open_scene(viewer, path)
    settle(viewer)
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


def test_a_file_that_is_still_is_not_spoken_of(shown):
    assert not look(shown)


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
    for word in ("mug", "book"):
        queries.ask(shown, word)
    settle(shown)
    mug, book = shown.state.queries
    queries.set_cut(shown, mug, 0.6)
    queries.hide(shown, book)
    queries.select(shown, mug)
    viewpoint.go_to_camera(shown, 1)
    viewpoint.tick(shown, shown.clock + 10)
    filming.add_keyframe(shown)
    settings.set_splats(shown, replace(shown.state.seeing.splats, size=0.5))
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
    assert (state.picture.display, state.picture.dim, state.seeing.splats.size) == ("relevancy", 0.1, 0.5)
    assert len(state.record.keyframes) == 1
    assert state.camera_index == 1
    assert not look(shown)
    assert errors(shown) == []


def test_a_reload_with_other_gaussians_asks_anew(shown):
    queries.ask(shown, "plant")
    settle(shown)
    half = np.arange(0, 360, 2)
    save_scene(shown.state.path, replace(blob_scene().take(half), path=None))
    opening.reload(shown)
    settle(shown)
    (query,) = shown.state.queries
    assert query.result.members.shape == (180,)
    assert shown.state.relevancies().shape == (180, 1)
    assert shown.state.selection.marks.selected.shape == (180,)


def test_canonical_phrases_outlive_a_reload(shown):
    queries.set_canonical(shown, "book, plant")
    queries.ask(shown, "mug")
    settle(shown)
    before = shown.state.queries[0].result.relevancy.copy()
    opening.reload(shown)
    settle(shown)
    assert shown.state.canonical == ("book", "plant")
    assert shown.engine.canonical_phrases == ("book", "plant")
    np.testing.assert_allclose(shown.state.queries[0].result.relevancy, before, atol=1e-6)


@pytest.mark.parametrize("name", ["blobs.ply", "blobs.langsplat.safetensors", "blobs.cameras.json"])
def test_a_half_written_file_leaves_the_scene_as_it_was(shown, name):
    queries.ask(shown, "mug")
    settle(shown)
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
    opening.keep_old(shown)
    assert not look(shown)
    os.utime(shown.state.path, ns=(2, 2))
    assert look(shown)


def test_a_field_that_went_away_takes_its_display_along(shown):
    queries.ask(shown, "mug")
    settle(shown)
    save_scene(shown.state.path, replace(blob_scene(field=False), path=None))
    opening.reload(shown)
    settle(shown)
    assert shown.state.picture.display == "rgb"
    assert shown.state.queries == []


def test_there_is_nothing_to_reload_before_a_scene_is_open(viewer):
    opening.reload(viewer)
    assert "open a scene first" in errors(viewer)[-1]


def test_a_watch_looks_by_itself_and_stops(tmp_path, monkeypatch):
    monkeypatch.setattr("langsplat_viewer.files.watching.EVERY", 0.005)
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
