"""Pictures and views to files."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from langsplat_core.io.cameras import read_cameras
from langsplat_viewer.output import saving
from tests.support.windowless import errors


def test_pictures_are_saved_under_new_names(opened, tmp_path):
    first, second = saving.save_picture(opened, tmp_path), saving.save_picture(opened, tmp_path)
    assert [first.name, second.name] == ["blobs-001.png", "blobs-002.png"]
    assert np.asarray(Image.open(second)).tolist() == np.full((6, 8, 3), 77).tolist()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["blobs-001.png", "blobs-002.png"]


def test_a_saved_view_can_be_read_again(opened, tmp_path):
    opened.state.size = (321, 123)
    camera = read_cameras(saving.save_view(opened, tmp_path))[0]
    expected = opened.state.view.camera(321, 123)
    assert (camera.width, camera.height) == (321, 123)
    assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
    assert camera.fx == pytest.approx(expected.fx)


def test_an_unwritable_folder_is_one_line(opened, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert saving.save_picture(opened, blocked) is None
    assert saving.save_view(opened, blocked) is None
    assert len(errors(opened)) == 2
    assert all("not saved" in text for text in errors(opened))


def test_nothing_to_save_before_a_scene_is_open(viewer, tmp_path):
    assert saving.save_picture(viewer, tmp_path) is None
    assert saving.save_view(viewer, tmp_path) is None
    assert len(errors(viewer)) == 2
