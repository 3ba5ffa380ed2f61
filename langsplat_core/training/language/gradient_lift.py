"""Lifting by gradient descent: latents trained through the rasterizer, as the paper does it.

LangSplat (section 3.3, and its public code): everything but the language features is frozen; a step
compares one photograph's latents H with the blended features, ``F = W y``, by their mean absolute difference
over pixels with a mask, and Adam moves the features x. The renderer is linear, so that a step is one `splat`
and one `gather`:

    d loss / d y = W^T (mask * sign(F - H)) / (pixels times d).

What is blended is y = x, or, as published, y = x / (|x| + 1e-9). The published start at zero then makes the
first gradients about 1e9 times too large, which Adam's second moment must forget before anything moves; from
the one-pass mean the same loss is reached much sooner. The three levels share W and do not otherwise meet:
one splat and one gather serve them all.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.compiled import kernel, plain, shared_workers
from langsplat_core.config import INRIA, LiftConfig, RasterSettings
from langsplat_core.progress import Progress, silent
from langsplat_core.ranges import check_settings
from langsplat_core.raster.protocol import FreezableView, LiftingRasterizer, LiftingView
from langsplat_core.scene import Camera, Codec, Gaussians
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.latent_lift import lift_latents

BETAS, EPSILON = (0.9, 0.999), 1e-15  # of Adam, as in the INRIA code
PUBLISHED_EPSILON = 1e-9  # in x / (|x| + 1e-9)
KEPT_BYTES = 4e9  # weights of views that are kept; further views are projected again at every step


@dataclass
class AdamState:
    """Adam (Kingma and Ba 2015) on one array."""

    x: Array  # float32
    first: Array
    second: Array
    steps: int = 0

    @staticmethod
    def begin(x: Array) -> "AdamState":
        """Before the first step."""
        return AdamState(x.astype(np.float32), np.zeros_like(x, np.float32), np.zeros_like(x, np.float32))

    def update(self, gradient: Array, lr: float) -> None:
        """One step, in place."""
        self.steps += 1
        corrected = (lr / (1 - BETAS[0] ** self.steps), 1 / (1 - BETAS[1] ** self.steps))
        flat = (array.reshape(-1) for array in (self.x, self.first, self.second, plain(gradient)))
        shared_workers().run(_adam, self.x.size, *flat, *(np.float32(factor) for factor in corrected))


@dataclass(frozen=True, eq=False)
class _Target:
    """One photograph: its camera, and what each pixel ought to show at every level."""

    camera: Camera
    labels: Array  # (3, H, W) int32, -1 for none
    latents: Array  # (M, d) float32 of the masks


def lift_by_gradient(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    config: LiftConfig,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """(3, N, d) float32 unit latents, zero where unobserved, and (3, N) confidence as of `lift_latents`.

    `config` says for how many steps, how fast, from where. Deterministic for a given seed on the CPU.
    """
    start, confidence = lift_latents(rasterizer, gaussians, views, codec, settings, progress)
    check_settings(config, "--lift.")
    published = config.start == "zeros-as-published"
    adam = AdamState.begin(np.zeros_like(start) if published else start)
    targets = [_target(camera, features, codec) for camera, features in views]
    weights = _Weights(rasterizer, gaussians, [camera for camera, _ in views], settings)
    for index in _shuffled(len(views), config.steps, config.seed):
        loss, by_y = loss_and_gradient(weights.of(index), targets[index], blended(adam.x, published))
        adam.update(by_features(adam.x, by_y) if published else by_y, config.lr)
        if adam.steps % 20 == 0 or adam.steps == config.steps:
            progress(f"training language features: loss {loss:.4f}", adam.steps / config.steps)
    latents = unit(adam.x)
    return np.where(confidence[..., None] > 0, latents, 0).astype(np.float32), confidence


def blended(x: Array, published: bool) -> Array:
    """(3, N, d) features -> what is blended."""
    if not published:
        return x
    return x / (np.linalg.norm(x, axis=-1, keepdims=True) + PUBLISHED_EPSILON)


def by_features(x: Array, by_y: Array) -> Array:
    """Gradient by x from that by y = x / (|x| + 1e-9); at zero the norm's own gradient counts as zero."""
    length = np.linalg.norm(x, axis=-1, keepdims=True)
    along = (x * by_y).sum(-1, keepdims=True) / np.maximum(length, 1e-30)
    return by_y / (length + PUBLISHED_EPSILON) - x * along / (length + PUBLISHED_EPSILON) ** 2


def loss_and_gradient(view: LiftingView, target: _Target, y: Array) -> tuple[float, Array]:
    """Masked L1 of one view, mean over levels, pixels and numbers, and its (3, N, d) gradient by y."""
    levels, count, d = y.shape
    image = view.splat(np.ascontiguousarray(np.moveaxis(y, 0, 1).reshape(count, levels * d)))[0]
    signs, losses = np.empty_like(image), np.empty(len(image))
    share = np.float32(1 / image.size)
    shared_workers().run(_compare, len(image), image, target.labels, target.latents, share, signs, losses)
    gradient = view.gather(signs)
    return float(losses.sum() / image.size), np.moveaxis(gradient.reshape(count, levels, d), 1, 0)


@kernel
def _compare(
    first: int,
    last: int,
    image: Array,
    labels: Array,
    latents: Array,
    share: float,
    signs: Array,
    losses: Array,
) -> None:
    """Rows [first, last) of a picture: `share` with the sign of (image - latents of the labels), zero where
    there is no label, and the sum of the absolute differences of each row."""
    levels, d = labels.shape[0], latents.shape[1]
    for row in range(first, last):
        total = 0.0
        for column in range(image.shape[1]):
            for channel in range(levels * d):
                label = labels[channel // d, row, column]
                difference = 0.0
                if label >= 0:
                    difference = image[row, column, channel] - latents[label, channel % d]
                total += abs(difference)
                signs[row, column, channel] = share * np.sign(difference)
        losses[row] = total


@kernel
def _adam(
    first: int,
    last: int,
    x: Array,
    mean: Array,
    square: Array,
    gradient: Array,
    rate: float,
    correction: float,
) -> None:
    """Numbers [first, last). rate: lr / (1 - beta1^t); correction: 1 / (1 - beta2^t)."""
    old, older = np.float32(BETAS[0]), np.float32(BETAS[1])
    for i in range(first, last):
        g = gradient[i]
        mean[i] = old * mean[i] + (np.float32(1) - old) * g
        square[i] = older * square[i] + (np.float32(1) - older) * g * g
        x[i] -= rate * mean[i] / (np.sqrt(square[i] * correction) + np.float32(EPSILON))


def _target(camera: Camera, features: ImageFeatures, codec: Codec) -> _Target:
    return _Target(camera, np.asarray(features.labels, np.int32), plain(codec.encode(features.vectors)))


def _shuffled(views: int, steps: int, seed: int) -> Iterator[int]:
    """`steps` indices of views, each view once in every pass."""
    generator = np.random.default_rng(seed)
    for step in range(steps):
        if step % views == 0:
            order = generator.permutation(views)
        yield int(order[step % views])


class _Weights:
    """The blending weights of every view, kept as far as memory allows: the geometry is frozen."""

    def __init__(
        self,
        rasterizer: LiftingRasterizer,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        settings: RasterSettings,
    ) -> None:
        self._rasterizer, self._gaussians = rasterizer, gaussians
        self._cameras, self._settings = cameras, settings
        self._kept: dict[int, LiftingView] = {}
        self._bytes = 0.0

    def of(self, index: int) -> LiftingView:
        """The view of camera `index`."""
        if index in self._kept:
            return self._kept[index]
        view = self._rasterizer.view(self._gaussians, self._cameras[index], self._settings)
        if not isinstance(view, FreezableView) or self._bytes > KEPT_BYTES:
            return view
        frozen = view.frozen()
        self._bytes += frozen.nbytes
        self._kept[index] = frozen
        return frozen
