"""A scene far from the origin still has a camera that frames it."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.scene import Scene
from tests.support.scenes import random_gaussians


@pytest.mark.parametrize("offset", [0.0, 1e4, 1e15, 3e38])
def test_a_camera_frames_any_scene(offset: float) -> None:
    """At 1e15 all positions are one float32 and the eye was the target: a camera of NaN."""
    gaussians = random_gaussians(20)
    scene = Scene(replace(gaussians, means=gaussians.means + np.float32(offset)))
    camera = scene.framing_camera((64, 48))
    assert np.isfinite(camera.world_to_camera).all()
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)
