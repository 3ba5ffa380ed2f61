"""Where to stand so that a scene fills the picture: plain maths on a sample of its Gaussians."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.scene import Gaussians, Intrinsics

SAMPLE = 50_000  # Gaussians looked at; quantiles need no more
SHARE = 0.99  # of the weight that a framing view holds: what is left out are floaters
MARGIN = 0.9  # of the picture's width and height that is filled
_BISECTIONS = 12


@dataclass(frozen=True, eq=False)
class Sample:
    """Gaussians that can be seen, as weighted points."""

    points: Array  # (M, 3) float64 world units
    weights: Array  # (M,) float64 > 0: opacity times size


def sample_of(gaussians: Gaussians) -> Sample:
    """Evenly spaced rows of those that can be drawn. The size of a Gaussian is the root of its largest
    section, a length: areas would let a few huge ones speak for all."""
    rows = np.flatnonzero(gaussians.valid())
    rows = rows[:: max(len(rows) // SAMPLE, 1)]
    sections = np.sort(gaussians.log_scales[rows].astype(np.float64), axis=1)[:, 1:].mean(1)
    weights = sigmoid(gaussians.opacity_logits[rows].astype(np.float64)) * np.exp(sections)
    seen = weights > 0
    return Sample(gaussians.means[rows][seen].astype(np.float64), weights[seen])


def reach(sample: Sample, centre: Array) -> float:
    """Distance from `centre` (3,) within which `SHARE` of the weight lies, world units; 0 without any."""
    return _quantile(np.linalg.norm(sample.points - centre, axis=1), sample.weights, SHARE)


def framing_eye(sample: Sample, rotation: Array, inner: Intrinsics, share: float = SHARE) -> Array | None:
    """(3,) where a camera of that `rotation` (world to camera) and `inner` geometry stands nearest while
    `share` of the weight lies in its picture, filled to `MARGIN`; None without points.

    A point is inside the right border where x - t z <= ex - t ez, with t the tangent of the angle to that
    border and e the eye: so a border is one number, the quantile of x - t z, and both eye and distance follow
    from four of them. Which share of the weight may lie beyond each border is found by bisection, because
    what is beyond one is often beyond another as well.
    """
    if not len(sample.points):
        return None
    points = sample.points @ rotation.T
    left, right = MARGIN * inner.cx / inner.fx, MARGIN * (inner.width - inner.cx) / inner.fx
    top, bottom = MARGIN * inner.cy / inner.fy, MARGIN * (inner.height - inner.cy) / inner.fy
    x, y, z = points.T
    borders = [x - right * z, -x - left * z, y - bottom * z, -y - top * z]
    ordered = [_ordered(border, sample.weights) for border in borders]

    def eye(beyond: float) -> Array:
        a, b, c, d = (_pick(border, 1 - beyond) for border in ordered)
        ez = min(-(a + b) / (right + left), -(c + d) / (bottom + top))
        # Along the other axis the nearest depth leaves room on both sides: the middle of it.
        return np.array([(a - b + (right - left) * ez) / 2, (c - d + (bottom - top) * ez) / 2, ez])

    low, high = (1 - share) / 4, 1 - share  # beyond each border: surely few enough; as many as allowed in all
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        e = eye(middle)
        limits = (e[0] - right * e[2], -e[0] - left * e[2], e[1] - bottom * e[2], -e[1] - top * e[2])
        inside = np.logical_and.reduce(
            [border <= limit + 1e-12 for border, limit in zip(borders, limits, strict=True)]
        )
        enough = sample.weights[inside].sum() >= share * sample.weights.sum()
        low, high = (middle, high) if enough else (low, middle)
    return np.asarray(eye(low) @ rotation)


def median_depth(sample: Sample, eye: Array, forward: Array) -> float:
    """How far ahead of `eye` (3,) along the unit `forward` (3,) half of the weight lies, world units."""
    return _quantile((sample.points - eye) @ forward, sample.weights, 0.5)


def nearest_depth(sample: Sample, eye: Array, forward: Array) -> float:
    """How far ahead of `eye` (3,) along the unit `forward` (3,) the scene begins but for `1 - SHARE` of its
    weight, world units; negative behind it."""
    return _quantile((sample.points - eye) @ forward, sample.weights, 1 - SHARE)


def _ordered(values: Array, weights: Array) -> tuple[Array, Array]:
    """(M,) values in rising order and the share of the weight up to each."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return values[order], cumulative / cumulative[-1]


def _pick(ordered: tuple[Array, Array], share: float) -> float:
    values, shares = ordered
    return float(values[min(int(np.searchsorted(shares, share - 1e-12)), len(values) - 1)])


def _quantile(values: Array, weights: Array, share: float) -> float:
    return _pick(_ordered(values, weights), share) if len(values) else 0.0
