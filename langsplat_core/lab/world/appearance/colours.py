"""Colour words: which displayed colours a word covers, and random colours a word covers.

Judged in CIE LCh (lightness, chroma, hue of CIE L*a*b*, D65). The borders follow where English
speakers change words in naming experiments (Berlin and Kay's eleven basic terms, beige and turquoise
added); near a border a colour has no certain word, and `colour_word` then answers None.
"""

import numpy as np

from langsplat_core.arrays import Array

SYNONYMS = {
    "gray": ("gray", "grey"),
    "turquoise": ("turquoise", "cyan"),
    "beige": ("beige", "tan"),
    "purple": ("purple", "violet"),
}
_WHITE = np.array([0.95047, 1.0, 1.08883])
_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
# word -> (lightness from, to, chroma from, to, hue from, to in degrees); hues may run past 360
_BOXES: dict[str, tuple[float, float, float, float, float, float]] = {
    "red": (28, 56, 52, 120, 16, 44),
    "orange": (58, 80, 56, 120, 52, 74),
    "yellow": (72, 97, 54, 120, 82, 104),
    "green": (28, 85, 28, 120, 118, 166),
    "turquoise": (52, 88, 24, 80, 182, 220),
    "blue": (20, 64, 30, 130, 254, 298),
    "purple": (20, 56, 32, 120, 307, 334),
    "pink": (66, 86, 24, 70, -14, 18),
    "brown": (20, 46, 18, 44, 44, 76),
    "beige": (72, 88, 12, 26, 70, 94),
    "black": (2, 17, 0, 5, 0, 360),
    "gray": (36, 68, 0, 5, 0, 360),
    "white": (90, 99, 0, 5, 0, 360),
}
COLOURS = tuple(_BOXES)


def to_linear(display: Array) -> Array:
    """sRGB display values in [0, 1] -> linear light."""
    display = np.asarray(display, np.float64)
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def to_display(linear: Array) -> Array:
    """Linear light (clipped to [0, 1]) -> sRGB display values."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def to_lch(display: Array) -> Array:
    """(..., 3) sRGB in [0, 1] -> (..., 3) CIE lightness [0, 100], chroma, hue in degrees [0, 360)."""
    ratio = to_linear(display) @ _TO_XYZ.T / _WHITE
    f = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    a, b = 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])
    return np.stack([116 * f[..., 1] - 16, np.hypot(a, b), np.degrees(np.arctan2(b, a)) % 360], -1)


def from_lch(lch: Array) -> Array:
    """Inverse of `to_lch`; colours outside sRGB come out beyond [0, 1] in linear light, unclipped."""
    hue = np.radians(lch[..., 2])
    fy = (lch[..., 0] + 16) / 116
    f = np.stack([fy + lch[..., 1] * np.cos(hue) / 500, fy, fy - lch[..., 1] * np.sin(hue) / 200], -1)
    ratio = np.where(f > 6 / 29, f**3, (116 * f - 16) * 27 / 24389)
    linear = (ratio * _WHITE) @ np.linalg.inv(_TO_XYZ).T
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * np.abs(linear) ** (1 / 2.4) - 0.055)


def colour_word(display: Array) -> str | None:
    """The word that certainly fits one sRGB colour (3,), or None near a border between words."""
    lightness, chroma, hue = to_lch(display)
    for word, (l0, l1, c0, c1, h0, h1) in _BOXES.items():
        if l0 <= lightness <= l1 and c0 <= chroma <= c1 and (hue - h0) % 360 <= h1 - h0:
            return word
    return None


def random_colour(word: str, rng: np.random.Generator) -> Array:
    """(3,) sRGB display values in [0, 1] that `word` certainly covers."""
    l0, l1, c0, c1, h0, h1 = _BOXES[word]
    for _ in range(1000):
        colour = from_lch(rng.uniform((l0, c0, h0), (l1, min(c1, 95), h1)))
        if colour.min() >= 0 and colour.max() <= 1:
            return colour
    raise ValueError(f"no displayable colour found for {word!r}")
