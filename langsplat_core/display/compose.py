"""From channels to a picture, in NumPy: the plain twin of the window's composite shader.

A rasterizer delivers premultiplied channels (colours, latent colours, relevancies, depth sums) and alpha;
`compose` turns them into what a person sees. Every step below exists once here and once in GLSL, and a
test compares the two.
"""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.scene import LanguageField

# Turbo colour map: polynomial fit published by A. Mikhailov, Google (2019), coefficients by channel.
_TURBO_COEFFICIENTS = np.array(
    [
        [0.13572138, 4.61539260, -42.66032258, 132.13108234, -152.94239396, 59.28637943],
        [0.09140261, 2.19418839, 4.84296658, -14.18503333, 4.27729857, 2.82956604],
        [0.10667330, 12.64194608, -60.58204836, 110.36276771, -89.90310912, 27.34824973],
    ]
)
# (256, 3) uint8; looked up with linear interpolation between nodes
TURBO = np.rint(
    255 * np.clip(np.linspace(0, 1, 256)[:, None] ** np.arange(6) @ _TURBO_COEFFICIENTS.T, 0, 1)
).astype(np.uint8)

QUERY_COLOURS = np.array([[0.98, 0.45, 0.09], [0.13, 0.59, 0.95], [0.30, 0.80, 0.35]])  # per shown query
RELEVANCY_FLOOR = 0.5  # "no better than the canonical phrases"
MIN_HEAT_SPAN = 0.1  # a peak closer than this to the floor is not stretched to full heat
HEAT_FADE = 0.35  # normalised heat at which the heat map reaches its full opacity
SEGMENT_OPACITY = 0.6


@dataclass(frozen=True, eq=False)
class Channels:
    """What one camera sees, as rasterized: every colour-like channel is premultiplied by alpha."""

    rgb: Array  # (H, W, 3)
    alpha: Array  # (H, W) in [0, 1]
    latent: Array | None = None  # (H, W, 3) latent colours
    relevancies: Array | None = None  # (H, W, Q), Q <= 3
    depth_sum: Array | None = None  # (H, W) sum of weight * camera z, world units
    depth_range: tuple[float, float] = (0.0, 1.0)  # near and far end of the depth display, world units


def turbo(t: Array) -> Array:
    """(...,) values in [0, 1] -> (..., 3) colours in [0, 1]."""
    position = np.clip(t, 0, 1) * 255
    low = np.minimum(position.astype(int), 254)
    fraction = (position - low)[..., None]
    table = TURBO / 255.0
    return table[low] * (1 - fraction) + table[low + 1] * fraction


def gated_mean(total: Array, alpha: Array, gate: float) -> Array:
    """Weighted sums (H, W, Q) / alpha where alpha exceeds `gate`, else 0: nothing there means nothing."""
    open_ = alpha > gate
    return np.where(open_[..., None], total / np.where(open_, alpha, 1)[..., None], 0)


def compose(channels: Channels, picture: PictureConfig, peaks: tuple[float, ...] = ()) -> Array:
    """(H, W, 3) uint8 picture. `peaks[j]` is the relevancy at which query j's heat saturates (default 1)."""
    background = np.asarray(picture.background)
    uncovered = (1 - channels.alpha)[..., None] * background
    colours = np.clip(channels.rgb + uncovered, 0, 1)
    shown = colours
    if picture.display == "alpha":
        shown = np.repeat(channels.alpha[..., None], 3, -1)
    elif picture.display == "latent" and channels.latent is not None:
        shown = channels.latent + uncovered
    elif picture.display == "depth" and channels.depth_sum is not None:
        shown = _depth_picture(channels, picture)
    elif picture.display in ("relevancy", "segmentation") and channels.relevancies is not None:
        relevancy = gated_mean(channels.relevancies, channels.alpha, picture.alpha_gate)
        draw = _heat_picture if picture.display == "relevancy" else _segment_picture
        shown = draw(colours, relevancy, picture, peaks)
    return np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8)


def _depth_picture(channels: Channels, picture: PictureConfig) -> Array:
    assert channels.depth_sum is not None
    near, far = channels.depth_range
    depth = gated_mean(channels.depth_sum[..., None], channels.alpha, picture.alpha_gate)[..., 0]
    t = np.clip((depth - near) / max(far - near, 1e-9), 0, 1)
    covered = channels.alpha > picture.alpha_gate
    return np.where(covered[..., None], turbo(1 - t), np.asarray(picture.background))


def _heat_picture(
    colours: Array, relevancy: Array, picture: PictureConfig, peaks: tuple[float, ...]
) -> Array:
    shown = relevancy.shape[-1]
    spans = [max(peak - RELEVANCY_FLOOR, MIN_HEAT_SPAN) for peak in peaks[:shown]]
    spans += [1 - RELEVANCY_FLOOR] * (shown - len(spans))
    heat = np.clip((relevancy - RELEVANCY_FLOOR) / spans, 0, 1).max(-1)
    fade = np.clip(heat / HEAT_FADE, 0, 1)
    mix = (picture.heat_opacity * fade * fade * (3 - 2 * fade))[..., None]  # smoothstep
    return colours * picture.dim * (1 - mix) + turbo(heat) * mix


def _segment_picture(
    colours: Array, relevancy: Array, picture: PictureConfig, peaks: tuple[float, ...]
) -> Array:
    del peaks  # a segmentation thresholds raw relevancy
    winner = relevancy.argmax(-1)
    inside = (relevancy.max(-1) > picture.threshold)[..., None]
    tinted = colours * (1 - SEGMENT_OPACITY) + QUERY_COLOURS[winner] * SEGMENT_OPACITY
    return np.where(inside, tinted, colours * picture.dim)


def latent_colours(field: LanguageField) -> Array:
    """(3, N, 3) float32 colours in [0, 1] of the latents at each level.

    For d = 3 the axes are the latent's own; otherwise the first three principal axes of all levels
    together (one basis for the scene, so that colours agree between views and levels; missing axes
    show grey). Each axis is stretched between its 2 % and 98 % quantiles. Unobserved Gaussians: grey.
    """
    levels, count, d = field.latents.shape
    latents = field.latents.reshape(-1, d).astype(np.float64)
    seen = field.confidence.reshape(-1) > 0
    if d != 3:
        centred = latents - latents[seen].mean(0) if seen.any() else latents
        _, axes = np.linalg.eigh(centred[seen].T @ centred[seen] + 1e-12 * np.eye(d))
        latents = centred @ axes[:, ::-1][:, :3]
        latents = np.pad(latents, ((0, 0), (0, 3 - latents.shape[1])))
    colours = np.full_like(latents, 0.5)
    if seen.any():
        low, high = np.quantile(latents[seen], [0.02, 0.98], axis=0)
        span = high - low
        stretched = (latents[seen] - low) / np.maximum(span, 1e-6)
        colours[seen] = np.where(span > 1e-6, np.clip(stretched, 0, 1), 0.5)
    return colours.reshape(levels, count, 3).astype(np.float32)
