"""A scene that was trained with antialiasing is drawn with it."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.config import INRIA, PictureConfig
from langsplat_core.io import load_scene, write_ply
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Scene
from langsplat_viewer.rendering.depth import ArrayChannels, Layers, Sight
from langsplat_viewer.rendering.renderer import GlRenderer
from tests.support.scenes import random_camera, random_gaussians

PICTURE = PictureConfig(display="alpha")


def small_scene(tmp_path, antialiased: bool) -> Scene:
    """Read from a file; its Gaussians are as small as pixels, where the compensation matters."""
    gaussians = random_gaussians(60, scale_range=(0.002, 0.02))
    write_ply(tmp_path / "a.ply", gaussians, ("SplatRenderMode: mip",) if antialiased else ())
    return load_scene(tmp_path / "a.ply")


@pytest.mark.parametrize("antialiased", [False, True])
def test_a_marked_file_is_drawn_as_the_reference_draws_it(tmp_path, gl, antialiased):
    scene, camera = small_scene(tmp_path, antialiased), random_camera(1)
    settings = replace(INRIA, antialiased=antialiased)
    reference = ReferenceRasterizer().view(scene.gaussians, camera, settings)
    _, want = reference.splat(np.zeros((60, 0)))
    _, other = (
        ReferenceRasterizer()
        .view(scene.gaussians, camera, replace(INRIA, antialiased=not antialiased))
        .splat(np.zeros((60, 0)))
    )
    assert np.abs(want - other).max() > 0.05  # the mark is worth something
    channels = ArrayChannels(load_rasterizer("cpu"))
    drawn = channels.render(Sight(scene, camera), Layers(), "none")
    np.testing.assert_allclose(drawn.alpha, want, atol=1e-4)
    row, column = np.unravel_index(np.argmax(want), want.shape)
    np.testing.assert_allclose(
        channels.depth_at(Sight(scene, camera), int(column), int(row))[1], want.max(), atol=1e-4
    )
    frame = GlRenderer(gl, "opengl", "single")
    frame.set_scene(scene)
    frame.draw(gl.simple_framebuffer((camera.width, camera.height)), camera, PICTURE)
    assert frame.depth_at(column + 0.5, row + 0.5) is not None
    alpha = frame.read(camera, PICTURE)[..., 0] / 255
    np.testing.assert_allclose(alpha, want, atol=0.5 / 255 + 1e-3)
    frame.release()


def test_the_same_gaussians_with_another_mark_are_projected_anew(tmp_path):
    scene, camera = small_scene(tmp_path, True), random_camera(1)
    channels = ArrayChannels(load_rasterizer("cpu"))
    first = channels.render(Sight(scene, camera), Layers(), "none").alpha
    second = channels.render(Sight(replace(scene, antialiased=False), camera), Layers(), "none").alpha
    assert np.abs(first - second).max() > 0.05
