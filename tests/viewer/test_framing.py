"""Standing where everything is seen, and not farther."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera, Intrinsics
from langsplat_viewer.camera.controls import SHARE, Sample, framing_eye, median_depth, reach, sample_of
from tests.support.scenes import random_gaussians

ROTATION = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
ROTATION *= np.sign(np.linalg.det(ROTATION))


def share_inside(sample: Sample, inner: Intrinsics, eye: Array) -> float:
    """Of the weight, by projecting every point."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = ROTATION, -ROTATION @ eye
    size = int(inner.width), int(inner.height)
    camera = Camera(*size, inner.fx, inner.fy, inner.cx, inner.cy, matrix)
    pixels, depth = camera.project(sample.points)
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels <= size).all(1)
    return float(sample.weights[inside].sum() / sample.weights.sum())


@pytest.fixture
def sample() -> Sample:
    """A cloud with a dense end, a long tail and very different weights, far from the origin."""
    rng = np.random.default_rng(7)
    points = rng.exponential(1.0, (3000, 3)) * (3.0, 1.0, 0.4) + (50.0, -20.0, 8.0)
    return Sample(points, rng.lognormal(0, 1.5, 3000))


@pytest.mark.parametrize(
    "inner",
    [
        Intrinsics(640, 360, 500, 500, 320, 180),
        Intrinsics(300, 700, 400, 400, 150, 350),
        Intrinsics(500, 400, 450, 300, 180, 260),  # a principal point off the centre, pixels not square
    ],
)
def test_the_share_is_held_and_a_step_nearer_loses_it(sample, inner):
    eye = framing_eye(sample, ROTATION, inner)
    assert share_inside(sample, inner, eye) >= SHARE
    depth = median_depth(sample, eye, ROTATION[2])
    assert share_inside(sample, inner, eye + 0.25 * depth * ROTATION[2]) < SHARE


def test_a_share_of_one_holds_every_point(sample):
    inner = Intrinsics(640, 360, 500, 500, 320, 180)
    assert share_inside(sample, inner, framing_eye(sample, ROTATION, inner, share=1.0)) == 1.0


def test_a_few_faint_floaters_do_not_count(sample):
    inner = Intrinsics(640, 360, 500, 500, 320, 180)
    far = np.concatenate([sample.points, [[1e6, 0, 0], [0, -1e6, 0]]])
    with_floaters = Sample(far, np.append(sample.weights, [1e-3, 1e-3]))
    assert_allclose(
        framing_eye(with_floaters, ROTATION, inner), framing_eye(sample, ROTATION, inner), atol=0.5
    )


def test_weights_are_opacity_times_size_and_faults_have_none():
    gaussians = random_gaussians(50)
    gaussians.means[3] = np.nan
    gaussians.opacity_logits[5] = -np.inf
    gaussians.log_scales[7] += np.log(2)
    plain = sample_of(random_gaussians(50))
    sample = sample_of(gaussians)
    assert len(sample.points) == 48
    assert_allclose(sample.weights[5], 2 * plain.weights[7], rtol=1e-5)  # two rows fewer before it


def test_nothing_has_no_view():
    nothing = Sample(np.zeros((0, 3)), np.zeros(0))
    assert framing_eye(nothing, ROTATION, Intrinsics(4, 3, 4, 4, 2, 1.5)) is None
    assert reach(nothing, np.zeros(3)) == 0
