"""The front door: one call from a scene and a camera to a picture."""

import doctest

import numpy as np
import pytest

import langsplat_core
from langsplat_core import Scene, render
from langsplat_core.config import GSPLAT
from langsplat_core.errors import BackendError, InputError
from langsplat_core.raster import load_lifting_rasterizer, load_rasterizer, reference
from langsplat_core.raster import render as front_door
from langsplat_core.raster.render import splat_colours
from tests.support.scenes import random_camera, random_gaussians, random_values

G, CAMERA = random_gaussians(80, 4, sh_degree=2), random_camera(2)


def test_the_example_in_the_docstring_runs():
    result = doctest.testmod(front_door)
    assert (result.attempted, result.failed) == (6, 0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_picture_is_project_colours_and_splat(backend: str) -> None:
    values = random_values(80, 2)
    picture = render(Scene(G), CAMERA, values, backend=backend)
    view = load_rasterizer("reference").view(G, CAMERA)
    colours = reference.colours(G.sh, G.means, CAMERA.position)
    want, alpha = view.splat(np.concatenate([colours, values], 1))
    np.testing.assert_allclose(picture.colours, want[..., :3], atol=2e-5)
    np.testing.assert_allclose(picture.values, want[..., 3:], atol=2e-5)
    np.testing.assert_allclose(picture.alpha, alpha, atol=2e-5)
    assert render(Scene(G), CAMERA, backend=backend).values.shape == (*alpha.shape, 0)


def test_the_scenes_antialiasing_and_the_profile_apply():
    raster = load_rasterizer("cpu")
    settings = Scene(G, antialiased=True).raster_settings(GSPLAT)
    assert settings.antialiased
    assert settings.near == GSPLAT.near
    want = splat_colours(raster.view(G, CAMERA, settings), G, CAMERA)
    got = render(Scene(G, antialiased=True), CAMERA, profile=GSPLAT)
    np.testing.assert_array_equal(got.colours, want.colours)
    assert not np.array_equal(got.colours, render(Scene(G), CAMERA).colours)


def test_what_cannot_draw_is_said():
    with pytest.raises(InputError, match="choose one of"):
        render(Scene(G), CAMERA, backend="vulkan")
    with pytest.raises(BackendError, match="--backend cpu"):
        render(Scene(G), CAMERA, backend="cuda")


def test_lifting_takes_what_the_machine_has():
    assert load_lifting_rasterizer("auto").name in ("cpu", "cuda")
    assert load_lifting_rasterizer("reference").name == "reference"
    with pytest.raises(InputError, match="cannot lift"):
        load_lifting_rasterizer("opengl")
    with pytest.raises(InputError, match="choose one of"):
        load_lifting_rasterizer("vulkan")


def test_every_public_name_is_there():
    for name in langsplat_core.__all__:
        assert getattr(langsplat_core, name).__doc__
    with pytest.raises(AttributeError, match="nothing_like_it"):
        getattr(langsplat_core, "nothing_like_it")  # noqa: B009  the module's own __getattr__ is meant
