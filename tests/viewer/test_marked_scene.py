"""The scene that is drawn for marks, and the canvas that notices them."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.render import splat_colours
from langsplat_viewer.marks import Marks, unmarked
from langsplat_viewer.staging import STRENGTH, TINT, edited_scene
from tests.support.fakes import blob_scene, cameras
from tests.support.scenes import random_gaussians
from tests.support.selected import blob

SCENE = blob_scene()
NOTHING = np.zeros(360, bool)


def test_without_marks_it_is_the_scene_itself():
    marks = unmarked(360)
    marked = edited_scene(SCENE, marks)
    assert marked.scene is SCENE
    assert marked.rows is None
    values = np.ones((360, 2))
    assert marked.layer(values) is values
    assert marked.layer(None) is None


def test_hidden_and_deleted_ones_are_left_out_with_their_rows_of_the_layers():
    marked = edited_scene(SCENE, Marks(NOTHING, blob("mug"), blob("plant")))
    np.testing.assert_array_equal(marked.rows, np.flatnonzero(blob("book")))
    np.testing.assert_array_equal(marked.scene.gaussians.means, SCENE.gaussians.means[blob("book")])
    values = np.arange(720).reshape(360, 2)
    np.testing.assert_array_equal(marked.layer(values), values[blob("book")])
    everything = np.ones(360, bool)
    assert len(edited_scene(SCENE, Marks(NOTHING, everything, NOTHING)).scene.gaussians) == 0


def test_only_the_selection_changes_its_colour_from_every_side():
    source = replace(SCENE, gaussians=random_gaussians(360, sh_degree=2), language=None)
    # Far from black, where colours are clamped and no longer linear.
    source.gaussians.sh[:, 0] = np.abs(source.gaussians.sh[:, 0]) + 1
    selected = blob("mug")
    tinted = edited_scene(source, Marks(selected, NOTHING, NOTHING)).scene
    for name in ("means", "log_scales", "quats_wxyz", "opacity_logits"):
        np.testing.assert_array_equal(getattr(tinted.gaussians, name), getattr(source.gaussians, name))
    np.testing.assert_array_equal(tinted.gaussians.sh[~selected], source.gaussians.sh[~selected])
    assert tinted.antialiased == source.antialiased
    for camera in cameras():
        ones = [scene.gaussians.take(selected) for scene in (source, tinted)]
        views = [load_rasterizer("reference").view(gaussians, camera) for gaussians in ones]
        before, after = (
            splat_colours(view, gaussians, camera) for view, gaussians in zip(views, ones, strict=True)
        )
        wanted = (1 - STRENGTH) * before.colours + STRENGTH * before.alpha[..., None] * TINT
        np.testing.assert_allclose(after.colours, wanted, atol=2e-5)


def test_colours_of_a_layer_are_tinted_alike_and_numbers_are_not():
    marked = edited_scene(SCENE, Marks(blob("book"), blob("mug"), NOTHING))
    colours = np.full((360, 3), 0.5, np.float32)
    mixed = marked.layer(colours, is_colour=True)
    wanted = np.tile((1 - STRENGTH) * 0.5 + STRENGTH * TINT, (120, 1))
    np.testing.assert_allclose(mixed[:120], wanted, rtol=1e-6)
    np.testing.assert_array_equal(mixed[120:], 0.5)
    np.testing.assert_array_equal(colours, 0.5)
    np.testing.assert_array_equal(marked.layer(colours), colours[:240])


def test_nothing_is_made_twice():
    marks = Marks(NOTHING, blob("mug"), NOTHING)
    first = edited_scene(SCENE, marks)
    assert edited_scene(SCENE, marks, first) is first
    selected = edited_scene(SCENE, replace(marks, selected=blob("book")), first)
    assert selected.untinted is first.scene
    assert selected.scene is not first.scene
    back = edited_scene(SCENE, replace(marks, selected=NOTHING), selected)
    assert back.scene is first.scene
    other = edited_scene(blob_scene(), marks, first)
    assert other.source is not SCENE
    assert other.scene is not first.scene


@pytest.mark.parametrize("count", [0, 359])
def test_marks_of_another_scene_count_as_none(count):
    everything = np.ones(count, bool)
    assert edited_scene(SCENE, Marks(everything, everything, everything)).scene is SCENE
