"""Looking from near and at small things; and a picture of nothing, which says why it is one."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.config import INRIA, PictureConfig
from langsplat_core.io import save_scene, write_cameras
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_viewer import __main__ as program
from langsplat_viewer.camera.controls import default_view, extent_of
from langsplat_viewer.output.still import render_picture
from langsplat_viewer.rendering.depth import near_plane, why_nothing, why_undrawable
from langsplat_viewer.rendering.renderer import GlRenderer
from tests.support.fakes import blob_scene

SIZE = (160, 120)


def scaled(factor: float) -> Scene:
    """The three blobs without cameras, `factor` times as large."""
    scene = blob_scene(field=False, with_cameras=False)
    gaussians = scene.gaussians
    smaller = replace(
        gaussians, means=factor * gaussians.means, log_scales=gaussians.log_scales + np.log(factor)
    )
    return replace(scene, gaussians=smaller)


def opening(scene: Scene) -> Camera:
    return default_view(scene, extent_of(scene), SIZE).camera(*SIZE)


@pytest.mark.parametrize("factor", [0.02, 1e-3, 300.0])
def test_a_scene_of_any_size_is_the_same_picture(factor):
    """Of radius 0.02 * 1.2 and less: nearer than training's near plane of 0.2."""
    plain, other = scaled(1.0), scaled(factor)
    expected = render_picture(plain, opening(plain), PictureConfig(), backend="cpu")
    assert (expected.max(-1) > 40).mean() > 0.02
    got = render_picture(other, opening(other), PictureConfig(), backend="cpu")
    assert np.abs(got.astype(int) - expected).max() <= 2


def test_a_view_of_a_photograph_is_the_one_that_was_trained():
    scene = blob_scene()
    for camera in scene.cameras:
        assert near_plane(scene.gaussians, camera) == INRIA.near


def test_the_near_plane_comes_along_to_a_thing():
    scene = blob_scene()
    ahead = scene.cameras[0]
    seen = []
    for left in (1.0, 0.15, 0.1):  # of the way to the middle
        matrix = ahead.world_to_camera.copy()
        matrix[:3, 3] *= left
        seen.append(near_plane(scene.gaussians, replace(ahead, world_to_camera=matrix)))
    assert seen[0] == INRIA.near
    assert seen[0] > seen[1] > seen[2] > 0


def faulty(**fields: object) -> Gaussians:
    return replace(blob_scene().gaussians, **fields)


def looking_away() -> Camera:
    camera = blob_scene().cameras[1]
    matrix = camera.world_to_camera.copy()
    matrix[[0, 2]] *= -1
    return replace(camera, world_to_camera=matrix)


NOTHING = {
    "empty": (blob_scene().gaussians.take(np.zeros(360, bool)), "the scene holds no Gaussians"),
    "nan": (faulty(means=np.full((360, 3), np.nan)), "none of the 360 Gaussians can be drawn"),
    "clear": (faulty(opacity_logits=np.full(360, -20.0)), "all 360 Gaussians are transparent"),
}


@pytest.mark.parametrize("case", NOTHING)
def test_why_no_camera_would_see_anything(case):
    gaussians, reason = NOTHING[case]
    assert why_undrawable(gaussians).startswith(reason)
    assert why_nothing(gaussians, blob_scene().cameras[0]).startswith(reason)
    assert np.isfinite(opening(Scene(gaussians)).world_to_camera).all()


def test_why_this_camera_sees_nothing():
    gaussians, camera = blob_scene().gaussians, blob_scene().cameras[1]
    assert why_undrawable(gaussians) == ""
    assert "behind the camera" in why_nothing(gaussians, looking_away())
    aside = camera.world_to_camera.copy()
    aside[0, 3] += 1e3
    assert "nothing of the scene lies in this picture" in why_nothing(
        gaussians, replace(camera, world_to_camera=aside)
    )


@pytest.mark.parametrize("backend", ["opengl", "cpu"])
def test_the_renderer_knows_an_empty_picture(gl, backend):
    renderer = GlRenderer(gl, backend)
    assert not renderer.shows_nothing()  # nothing was drawn yet
    renderer.set_scene(blob_scene())
    for camera, nothing in ((blob_scene().cameras[0], False), (looking_away(), True)):
        renderer.read(camera, PictureConfig())
        assert renderer.shows_nothing() == nothing
    renderer.release()


@pytest.mark.parametrize("case", [*NOTHING, "away"])
def test_without_a_window_nothing_is_one_line_and_no_file(case, tmp_path: Path, monkeypatch, capsys):
    gaussians, reason = NOTHING.get(case, (blob_scene().gaussians, "behind the camera"))
    save_scene(tmp_path / "scene.ply", Scene(gaussians))
    write_cameras(tmp_path / "view.json", (looking_away(),))
    options = ["--camera", str(tmp_path / "view.json")] if case == "away" else []
    out = tmp_path / "a.png"
    arguments = [str(tmp_path / "scene.ply"), "--headless", "--backend", "cpu", "--out", str(out), *options]
    monkeypatch.setattr(sys, "argv", ["langsplat-viewer", *arguments])
    with pytest.raises(SystemExit) as stop:
        program.entry()
    assert stop.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert reason in lines[0]
    assert not out.exists()


def test_radii_of_the_small_scene_are_what_the_picture_claims():
    assert_allclose(extent_of(scaled(0.02)).radius, 0.02 * extent_of(scaled(1.0)).radius, rtol=1e-4)
