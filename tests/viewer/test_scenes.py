"""Several scenes to switch between, without a window."""

from pathlib import Path

import numpy as np
import pytest

from langsplat_viewer.actions import filming, opening, queries, settings, viewpoint
from langsplat_viewer.actions.opening import MOST
from langsplat_viewer.drawing.channels import UNCLIPPED, Clip
from langsplat_viewer.files.browsing import list_folder
from langsplat_viewer.panels.scene import has_several
from tests.support.windowless import SCENES, arrive, errors, settle

BLOBS, PLAIN, BARE = (Path(f"{name}.ply").absolute() for name in ("blobs", "plain", "bare"))


@pytest.fixture
def three(viewer):
    """Three scenes were dropped; the first is shown."""
    opening.open_dropped(viewer, [Path("blobs.ply"), Path("plain.ply"), Path("bare.ply")])
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
    for word in ("mug", "book"):
        queries.ask(three, word)
    settle(three)
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
    assert three.state.seeing.clip == UNCLIPPED
    queries.ask(three, "plant")
    settle(three)
    viewpoint.zoom_by(three, 2.0)
    bare = three.state.view

    switch(three, BLOBS)
    state = three.state
    assert state.view is view
    assert [(q.phrase, q.slot, q.cut) for q in state.queries] == [("mug", None, None), ("book", 1, 0.7)]
    assert state.queries[1].result.own_cut == 0.7
    assert state.canonical == three.engine.canonical_phrases == ("plant",)
    assert (state.camera_index, len(state.record.keyframes)) == (2, 1)
    assert state.seeing.clip == Clip(1.0, 9.0)
    switch(three, BARE)
    assert three.state.view is bare
    assert [query.phrase for query in three.state.queries] == ["plant"]
    assert three.state.shown_results()[0].found
    assert three.engine.canonical_phrases != ("plant",)


def test_a_display_of_answers_comes_back_after_a_scene_without(three):
    queries.ask(three, "mug")
    settle(three)
    switch(three, PLAIN)
    assert three.state.picture.display == "rgb"
    switch(three, BLOBS)
    assert three.state.picture.display == "relevancy"


def test_nothing_of_a_scene_that_was_left_is_kept_in_memory(three):
    queries.ask(three, "mug")
    settle(three)
    switch(three, BARE)
    (visit,) = three.visits.values()
    assert [query.result for query in visit.queries] == [None]
    assert not any(isinstance(value, np.ndarray) and value.size > 16 for value in vars(visit).values())


def test_steps_go_round(three):
    seen = []
    for by in (1, 1, 1, -1):
        opening.step_scene(three, by)
        settle(three)
        seen.append(three.state.path.absolute())
    assert seen == [PLAIN, BARE, BLOBS, BARE]


def test_one_scene_has_no_next(opened):
    assert opened.state.scenes == (BLOBS,)
    opening.step_scene(opened, 1)
    assert "no other scene" in errors(opened)[-1]


def test_a_scene_that_is_opened_joins_the_list_once(three):
    opening.open_scene(three, Path("book.ply"))
    settle(three)
    assert three.state.scenes[-1].name == "book.ply"
    opening.add_scenes(three, [Path("book.ply"), PLAIN])
    assert len(three.state.scenes) == 4


def test_a_scene_is_taken_off_the_list(three):
    switch(three, PLAIN)
    opening.unlist_scene(three, BLOBS)
    assert three.state.scenes == (PLAIN, BARE)
    assert three.visits == {}
    opening.step_scene(three, 1)
    settle(three)
    assert three.state.path == BARE


def test_a_broken_scene_leaves_the_shown_one(three):
    opening.add_scenes(three, [Path("broken.ply")])
    switch(three, Path("broken.ply").absolute())
    assert three.state.scene is SCENES["blobs.ply"]
    assert "broken" in errors(three)[-1]


def test_the_list_ends(viewer):
    opening.add_scenes(viewer, [Path(f"{number}.ply") for number in range(MOST + 5)])
    assert len(viewer.state.scenes) == MOST


def test_all_scenes_of_a_folder_are_opened_together(viewer, tmp_path):
    for name in ("blobs.ply", "plain.ply", "a.queries.json"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder").mkdir()
    viewer.state.browser = list_folder(tmp_path)
    assert has_several(viewer.state.browser)
    opening.open_all(viewer)
    settle(viewer)
    assert viewer.state.browser is None
    assert viewer.state.scenes == (tmp_path / "blobs.ply", tmp_path / "plain.ply")
    assert viewer.state.path.name == "blobs.ply"
    (tmp_path / "plain.ply").unlink()
    assert not has_several(list_folder(tmp_path))
