"""The scene and the selection are transformed and cropped, as seen and as saved; and that is undone."""

from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.scene.transform import AXES, IDENTITY, moving, rotating, scaling
from langsplat_viewer.actions import editing, opening, saving
from langsplat_viewer.panels.select import box_of, dragged, gl_matrices
from langsplat_viewer.state import EditForm
from tests.support.fakes import CENTRES
from tests.support.scenes import random_camera, without_perspective
from tests.support.windowless import act, ask, errors, open_scene, result, settle

MUG = CENTRES[0]
STEP = np.array([0.0, 2.0, -1.0])


def selected_mug(viewer) -> np.ndarray:
    ask(viewer, "mug")
    editing.select_query(viewer)
    chosen: np.ndarray = viewer.state.marks.selected
    assert 0 < chosen.sum() < len(chosen)
    return chosen


def means(viewer) -> np.ndarray:
    return viewer.state.scene.gaussians.means


def test_transform_moves_only_the_selection(opened):
    chosen, before = selected_mug(opened), means(opened)
    place, cameras = result(opened, 0).place, opened.state.scene.cameras
    act(editing.transform, opened, moving(STEP))
    np.testing.assert_allclose(means(opened)[chosen], before[chosen] + STEP, atol=1e-5)
    np.testing.assert_array_equal(means(opened)[~chosen], before[~chosen])
    assert opened.state.scene.cameras is cameras
    np.testing.assert_allclose(result(opened, 0).place, place + STEP, atol=1e-4)
    np.testing.assert_array_equal(opened.state.marks.selected, chosen)
    act(editing.name_selection, opened, "trophy")  # what is taught goes along
    act(editing.transform, opened, moving(STEP))
    assert opened.engine.is_taught("trophy")
    assert [word.name for word in opened.state.scene.language.taught] == ["trophy"]
    opened.state.saved = opened.state.session
    open_scene(opened, "plain.ply")  # begins without transforms, and has no language field
    assert (opened.state.session.moves, opened.state.opened) == ((), None)
    before = means(opened)
    act(editing.transform, opened, moving(STEP))
    np.testing.assert_allclose(means(opened), before + STEP, atol=1e-5)
    assert opened.state.scene.language is None


def test_transform_of_the_scene_moves_its_cameras(opened):
    up, before = opened.state.extent.up, means(opened)
    eyes = [camera.position for camera in opened.state.scene.cameras]
    to = rotating(AXES["z"], 90).then(scaling(3)).then(moving(STEP))
    editing.transform(opened, to)
    np.testing.assert_allclose(means(opened), to.points(before), atol=1e-4)
    moved = [camera.position for camera in opened.state.scene.cameras]
    np.testing.assert_allclose(moved, to.points(np.array(eyes)), atol=1e-9)
    np.testing.assert_allclose(opened.state.extent.up, to.rotation @ up, atol=1e-6)


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
    assert opened.state.request((32, 24)).scene.source is opened.state.scene


def test_transformed_scene_is_saved_as_seen(opened, tmp_path):
    selected_mug(opened)
    editing.transform(opened, moving(STEP))
    act(saving.export, opened, tmp_path, "edited")
    made = load_scene(next(tmp_path.glob("*.ply")))
    np.testing.assert_array_equal(made.gaussians.means, means(opened))
    assert made.language is not None
    assert not opened.state.is_unsaved
    editing.transform(opened, moving(STEP))
    opening.open_scene(opened, Path("plain.ply"))  # is asked about first
    assert opened.state.leaving is not None


def test_crop_deletes_outside_the_box_and_is_undone(opened):
    chosen = selected_mug(opened)
    editing.fill_box(opened)
    editing.crop(opened)
    marks = opened.state.marks
    assert (marks.kept[chosen]).all()
    assert 0 < marks.kept.sum() < len(chosen)
    editing.undo(opened)
    assert opened.state.marks.kept.all()
    opened.state.edit_form = EditForm(low=(50.0, 50, 50), high=(51.0, 51, 51))
    editing.crop(opened)
    assert "holds nothing" in errors(opened)[-1]
    assert opened.state.marks.kept.all()


def test_cropping_keeps_earlier_deletions(opened):
    chosen = selected_mug(opened)
    editing.delete_selected(opened)
    editing.select_all(opened)
    editing.set_box(opened, (-50.0, -50, -50), (50.0, 50, 50))
    editing.crop(opened)
    np.testing.assert_array_equal(opened.state.marks.deleted, chosen)


def test_panel_numbers_transform_about_the_middle(opened):
    """Scaled and rotated about the middle of the selection, then moved; then the fields are neutral again."""
    before = opened.state.scene
    refused = (EditForm(scale=0), EditForm(scale=-1), EditForm(move=(1e39, 0.0, 0.0)))
    for count, form in enumerate(refused, start=1):
        opened.state.edit_form = form
        editing.apply_form(opened)
        assert len(errors(opened)) == count
    assert opened.state.scene is before
    editing.undo(opened)
    assert "nothing to undo" in opened.state.messages[-1].text
    chosen, before = selected_mug(opened), means(opened)
    centre = editing.pivot(opened)
    form = EditForm(move=(1.0, 0.0, 0.0), rotate=(0.0, 0.0, 90.0), scale=2.0)
    opened.state.edit_form = form
    editing.apply_form(opened)
    x, y, z = (before[chosen] - centre).T
    expected = centre + np.stack([1 - 2 * y, 2 * x, 2 * z], 1)
    np.testing.assert_allclose(means(opened)[chosen], expected, atol=1e-5)
    assert opened.state.edit_form == EditForm()


def test_transforms_without_a_scene_do_nothing(viewer):
    for action in (editing.apply_form, editing.crop, editing.fill_box):
        action(viewer)
    editing.preview(viewer, moving(STEP))
    assert viewer.state.moving is None


@pytest.mark.parametrize("perspective", [True, False])
def test_gizmo_matrices_agree_with_the_camera(perspective):
    camera = random_camera(3)
    camera = camera if perspective else without_perspective(camera)
    points = np.random.default_rng(0).normal(scale=0.3, size=(20, 3))
    view, projection = gl_matrices(camera, 3.0)
    clip = np.c_[points, np.ones(20)] @ (projection @ view).T
    x, y, depth = (clip[:, :3] / clip[:, 3:]).T
    pixels, _ = camera.project(points)
    np.testing.assert_allclose((x + 1) / 2 * camera.width, pixels[:, 0], atol=1e-9)
    np.testing.assert_allclose((1 - y) / 2 * camera.height, pixels[:, 1], atol=1e-9)
    assert (np.abs(depth) < 1).all()


def test_gizmo_drags_become_similarities():
    box = np.diag([2.0, -4.0, 6.0, 1.0])  # a handle was dragged beyond the opposite one
    box[:3, 3] = 1.0, 2.0, 3.0
    assert box_of(box) == ((0.0, 0.0, 0.0), (2.0, 4.0, 6.0))
    start = moving(np.array([1.0, 2.0, 3.0])).matrix
    turned = rotating(AXES["y"], 20).about(start[:3, 3])
    np.testing.assert_allclose(dragged(start, turned.matrix @ start).matrix, turned.matrix, atol=1e-9)
    stretched = start.copy()
    stretched[:3, :3] = np.diag([1.0, 1.4, 1.0])
    grown = dragged(start, stretched)
    assert grown.scale == pytest.approx(1.4)
    np.testing.assert_allclose(grown.points(start[None, :3, 3])[0], start[:3, 3])
    stretched[:3, :3] = 0
    with pytest.raises(InputError):
        dragged(start, stretched)
