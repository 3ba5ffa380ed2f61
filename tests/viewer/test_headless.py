"""Pictures without a window: with a GL context, and where there is no driver for one."""

import os
import subprocess
import sys

import numpy as np
import pytest

from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.scene import Scene
from langsplat_viewer.output.still import render_picture
from tests.support.scenes import random_camera, random_gaussians, random_values

SCENE = Scene(random_gaussians(150, sh_degree=3))
CAMERA = random_camera(1, distance=2.0)
LAYERS = {
    "latent_rgb": random_values(150, 3, 1),
    "relevancies": random_values(150, 2, 2),
    "heat_ranges": ((0.5, 0.9), (0.5, 0.6)),
}


@pytest.mark.parametrize("display", DISPLAYS)
def test_headless_pictures_agree(gl, display):
    picture = PictureConfig(display=display, background=(0.2, 0.5, 0.9))
    with_gl = render_picture(SCENE, CAMERA, picture, backend="opengl", **LAYERS)
    without = render_picture(SCENE, CAMERA, picture, backend="cpu", **LAYERS)
    difference = np.abs(with_gl.astype(int) - without).max(-1)
    assert np.quantile(difference, 0.95) <= 4  # half floats, and heat colours that magnify them


NO_DRIVER = """
import sys
from langsplat_core.errors import BackendError
from langsplat_viewer.output.still import render_picture
from langsplat_core.config import PictureConfig
from langsplat_core.scene import Scene
from tests.support.scenes import random_camera, random_gaussians
scene = Scene(random_gaussians(20))
for backend in ("auto", "cpu"):
    assert render_picture(scene, random_camera(), PictureConfig(), backend=backend).any()
try:
    render_picture(scene, random_camera(), PictureConfig(), backend="opengl")
except BackendError as error:
    assert "libegl1" in str(error) and "--backend cpu" in str(error) and "\\n" not in str(error)
    print("refused")
print([name for name in ("glfw", "imgui_bundle") if name in sys.modules])
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="hides EGL's drivers from its loader")
@pytest.mark.parametrize(
    "driver",
    [
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"},
        {"MESA_GL_VERSION_OVERRIDE": "2.1", "MESA_GLSL_VERSION_OVERRIDE": "120"},
        {"MESA_GL_VERSION_OVERRIDE": "3.3FC", "MESA_GLSL_VERSION_OVERRIDE": "330"},
    ],
    ids=["none", "2.1", "3.3"],
)
def test_without_a_driver_that_suffices_the_cpu_still_makes_pictures(gl, driver):
    if "MESA_GL_VERSION_OVERRIDE" in driver and "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    run = subprocess.run(
        [sys.executable, "-c", NO_DRIVER], env=os.environ | driver, capture_output=True, text=True
    )
    assert run.stdout.split("\n")[:2] == ["refused", "[]"], run.stderr
