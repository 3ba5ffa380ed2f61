"""The Gaussians of a scene, raw as in the INRIA PLY, and their merging into fewer, larger ones."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from math import isqrt

import numpy as np

from langsplat_core.arrays import Array, check_array, logit, pieces, quaternions, rotation_matrices, sigmoid
from langsplat_core.config import INRIA
from langsplat_core.errors import report_loss
from langsplat_core.progress import Progress, silent

SH_COUNTS = {0: 1, 1: 4, 2: 9, 3: 16}  # degree -> coefficients per colour channel
LARGEST_COEFFICIENT = 1e20  # of the spherical harmonics: sums of sixteen and their gradients fit a float32
FAULTS = (  # reasons for which a row is not drawn
    "position not finite",
    "scale not a number or above e^80",
    "rotation zero or not finite",
    "opacity not a number",
    "colour not finite or above 1e20",
)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N anisotropic Gaussians as float32 arrays. Invalid rows stay, but are not drawn."""

    means: Array  # (N, 3) world units
    log_scales: Array  # (N, 3) natural logarithm of world units; -inf is a flat axis
    quats_wxyz: Array  # (N, 4) any non-zero length, normalised on use
    opacity_logits: Array  # (N,) +-inf allowed: opacity 1 and 0
    sh: Array  # (N, K, 3) spherical harmonics, K = 1, 4, 9 or 16; colour = 0.5 + SH(direction)

    def __post_init__(self) -> None:
        given = np.asarray(self.means)
        for field in fields(self):
            with np.errstate(over="ignore", invalid="ignore"):  # of doubles in files: such rows are not drawn
                value = np.ascontiguousarray(getattr(self, field.name), dtype=np.float32)
            object.__setattr__(self, field.name, value)
        dims = check_array("means", self.means, ("N", 3))
        check_array("log_scales", self.log_scales, ("N", 3), dims)
        check_array("quats_wxyz", self.quats_wxyz, ("N", 4), dims)
        check_array("opacity_logits", self.opacity_logits, ("N",), dims)
        check_array("sh", self.sh, ("N", "K", 3), dims)
        if self.sh.shape[1] not in SH_COUNTS.values():
            raise ValueError(f"sh: expected 1, 4, 9 or 16 coefficients, got {self.sh.shape[1]}")
        if given.dtype == np.float64 and len(self):
            some = slice(None, None, len(self) // 4096 + 1)
            if step := coarse_step(self.log_scales[some], np.median(np.abs(self.means[some]).max(1))):
                report_loss("positions so far from zero are rounded to %g units: give Scene an origin", step)

    def __repr__(self) -> str:
        return f"<{len(self):,} Gaussians, SH degree {self.sh_degree}>"

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return isqrt(self.sh.shape[1]) - 1

    def take(self, rows: Array) -> "Gaussians":
        """Return the Gaussians at `rows`: indices or a boolean mask of length N."""
        return Gaussians(*(getattr(self, field.name)[rows] for field in fields(self)))

    @cached_property
    def sample(self) -> "Gaussians":
        """At most 10 000 valid Gaussians of at least INRIA's `alpha_min` opacity, evenly sampled."""
        some = self.take(np.arange(0, len(self), len(self) // 10_000 + 1))
        return some.take(some.valid() & (some.opacity_logits >= float(logit(np.array(INRIA.alpha_min)))))

    def valid(self) -> Array:
        """Return (N,) bool, True where a row can be drawn; `invalid_rows` says why others cannot."""
        return self._faults == 0

    def invalid_rows(self) -> dict[str, int]:
        """Return why rows are not valid: reason -> count. A row counts once, under its first reason."""
        counts = np.bincount(self._faults, minlength=len(FAULTS) + 1)[1:].tolist()
        return {reason: count for reason, count in zip(FAULTS, counts, strict=True) if count}

    @cached_property
    def _faults(self) -> Array:
        """The (N,) uint8 number, from 1, of the first of `FAULTS` that a row has; 0: none."""
        faults = np.zeros(len(self), np.uint8)
        for rows in pieces(len(self), 8192):
            with np.errstate(over="ignore", invalid="ignore"):
                quats = self.quats_wxyz[rows].astype(np.float64)
                length_squared = np.einsum("ij,ij->i", quats, quats)
                sound_colour = np.abs(self.sh[rows]) <= LARGEST_COEFFICIENT
            sound = (
                np.isfinite(self.means[rows]),
                self.log_scales[rows] <= 80,  # exp(88.7) overflows float32; NaN compares False
                np.isfinite(length_squared) & (length_squared > 1e-24),
                ~np.isnan(self.opacity_logits[rows]),
                sound_colour,
            )
            for number in range(len(FAULTS), 0, -1):
                if not sound[number - 1].all():  # a test of each row takes far longer
                    each = sound[number - 1].reshape(len(faults[rows]), -1).all(1)
                    faults[rows][~each] = number
        return faults


def coarse_step(log_scales: Array, far: float) -> float:
    """Return the step of float32 so `far` from zero; 0 unless it exceeds the size of most Gaussians."""
    step = float(np.spacing(np.float32(far)))
    return step if np.log(step) > np.median(log_scales.max(axis=1)) else 0.0


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Return the Gaussians of all `parts`, in order; harmonics of lower degrees are filled up with zeros."""
    if not parts:
        return Gaussians(*(np.zeros(shape) for shape in ((0, 3), (0, 3), (0, 4), 0, (0, 1, 3))))
    if len(parts) == 1:
        return parts[0]
    count = max(part.sh.shape[1] for part in parts)
    columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(Gaussians)}
    columns["sh"] = [
        np.pad(sh, ((0, 0), (0, count - sh.shape[1]), (0, 0))) if sh.shape[1] < count else sh
        for sh in columns["sh"]
    ]
    return Gaussians(**{name: np.concatenate(column) for name, column in columns.items()})


# Level of detail: fewer and larger Gaussians, for fast images. Four neighbours are merged where their mixture
# is about one blob: the merged Gaussian has the mean and covariance of the mixture, weighted by opacity times
# area, and the same optical depth.

GROUP = 4  # Gaussians that are merged into one
SPREAD = 2.0  # the largest ratio of the variance of the mixture to that of its members
BLOCK = 1 << 15  # groups handled at a time, some 40 MB
_OPAQUE = 0.999  # largest opacity: the optical depth of 1 is infinite
_TINY = 1e-30
_GRID_BITS = 20  # bits of each coordinate in a Morton code
_SPACED = (  # shifts and masks that put two free bits behind every bit
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


@dataclass(frozen=True, eq=False)
class Merged:
    """M Gaussians merged from N, with the weights of the originals in each."""

    gaussians: Gaussians
    sources: Array  # (M, GROUP) rows of the N that each is made of
    weights: Array  # (M, GROUP) float32 weights of these; rows sum to 1

    def values(self, values: Array | None) -> Array | None:
        """Return (M, C) float32 means of the original Gaussians' (N, C) values."""
        if values is None:
            return None
        return np.einsum("mg,mgc->mc", self.weights, np.asarray(values, np.float32)[self.sources])


# Gaussians, (m, GROUP) rows of the original that each is made of, and (m, GROUP) weights of these.
_Part = tuple[Gaussians, Array, Array]


def merged(gaussians: Gaussians, progress: Progress = silent) -> Merged:
    """Return the valid Gaussians merged, from a quarter as many up to all of them, in another order."""
    rows = np.flatnonzero(gaussians.valid())
    rows = rows[np.argsort(along_curve(gaussians.means[rows]))]
    grouped = rows[: len(rows) // GROUP * GROUP].reshape(-1, GROUP)
    parts = [_kept(gaussians, rows[grouped.size :])]
    for start in range(0, len(grouped), BLOCK):
        progress("merging", start / len(grouped))
        parts += _merge(gaussians, grouped[start : start + BLOCK])
    found, sources, weights = zip(*parts, strict=True)
    shares = np.concatenate(weights).astype(np.float32)
    return Merged(join_gaussians(found), np.concatenate(sources), shares)


def along_curve(points: Array) -> Array:
    """Return (N,) uint64 Morton codes of (N, 3) points: close codes are mostly close points."""
    if len(points) == 0:
        return np.zeros(0, np.uint64)
    # Neither a single floater nor a far background may use up the grid.
    low, high = np.quantile(points.astype(np.float64), [0.01, 0.99], axis=0)
    cells = (points - low) / max((high - low).max(), _TINY)
    code = np.zeros(len(points), np.uint64)
    for axis in range(3):
        bits = (np.clip(cells[:, axis], 0, 1) * (2**_GRID_BITS - 1)).astype(np.uint64)
        for shift, mask in _SPACED:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        code |= bits << np.uint64(axis)
    return code


def _kept(gaussians: Gaussians, rows: Array) -> _Part:
    weights = np.zeros((len(rows), GROUP))
    weights[:, 0] = 1
    return gaussians.take(rows), np.repeat(rows[:, None], GROUP, 1), weights


def _area(scales: Array) -> Array:
    """Return (...) areas of ellipsoids of (..., 3) scales in projection: about the mean, up to a constant."""
    a, b, c = np.moveaxis(scales, -1, 0)
    return np.asarray(a * b + b * c + c * a)


def _merge(gaussians: Gaussians, rows: Array) -> Iterator[_Part]:
    """Merge each of (G, GROUP) rows into one Gaussian; yield the merged ones, then the unmerged members."""
    members = gaussians.take(rows.ravel())
    scales = np.exp(members.log_scales.astype(np.float64))
    axes = rotation_matrices(members.quats_wxyz.astype(np.float64)) * scales[:, None, :]
    opacities = sigmoid(members.opacity_logits.astype(np.float64))
    areas = _area(scales)
    weights = (opacities * areas + _TINY).reshape(rows.shape)
    weights /= weights.sum(1, keepdims=True)
    means = members.means.astype(np.float64).reshape(*rows.shape, 3)
    mean = (weights[..., None] * means).sum(1)
    own = (weights[..., None, None] * (axes @ axes.swapaxes(1, 2)).reshape(*rows.shape, 3, 3)).sum(1)
    apart = np.sqrt(weights)[..., None] * (means - mean[:, None])
    covariance = own + apart.swapaxes(1, 2) @ apart
    alike = np.trace(covariance, axis1=1, axis2=2) <= SPREAD * np.trace(own, axis1=1, axis2=2)
    depths = (areas * -np.log1p(-np.minimum(opacities, _OPAQUE))).reshape(rows.shape).sum(1)
    sh = (weights[..., None, None] * members.sh.reshape(*rows.shape, *members.sh.shape[1:])).sum(1)
    log_scales, quats, area = _ellipsoids(covariance[alike])
    opacity = np.clip(1 - np.exp(-depths[alike] / np.maximum(area, _TINY)), 0, _OPAQUE)
    blobs = Gaussians(mean[alike], log_scales, quats, logit(opacity), sh[alike])
    yield blobs, rows[alike], weights[alike]
    yield _kept(gaussians, rows[~alike].ravel())


def _ellipsoids(covariances: Array) -> tuple[Array, Array, Array]:
    """Return (G, 3) logarithms of scales, (G, 4) quaternions wxyz and (G,) `_area` of covariances."""
    variances, axes = np.linalg.eigh(covariances)
    axes[:, :, 0] *= np.sign(np.linalg.det(axes))[:, None]  # a rotation, no reflection
    scales = np.sqrt(np.maximum(variances, _TINY))
    return np.minimum(np.log(scales), 80.0), quaternions(axes), _area(scales)
