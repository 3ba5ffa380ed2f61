"""Colours of photographs and videos as sRGB, from profiles and from the numbers of ITU-T H.273.

ICC profiles are applied by littlecms, through Pillow. PNG's gAMA and cICP, HEIC without a profile and videos
name a transfer function, from light to numbers, and the primaries of the channels. The HDR functions HLG and
PQ are scaled to the diffuse white of BT.2408; brighter colours become white.
"""

import io
import struct
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageCms

from langsplat_core.arrays import Array, linear_light
from langsplat_core.errors import Tell

UNSPECIFIED, LINEAR, PQ, HLG = 2, 8, 16, 18
# Displays show all of these as they show sRGB: BT.709, BT.601, BT.1361, sRGB, BT.2020 of 10 and of 12 bits.
AS_DISPLAYED = (UNSPECIFIED, 1, 6, 11, 12, 13, 14, 15)
GAMMAS = {4: 2.2, 5: 2.8}
HLG_WHITE, PQ_WHITE = 0.26496, 0.0203  # of the scale's largest: 75 % of the signal; 203 cd/m2
D65 = 0.3127, 0.3290
# x and y of red, green, blue and white; those of SD video (4 to 7) show as BT.709's to within a few of 255
SRGB = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *D65)
ADOBE = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65)
PRIMARIES = dict.fromkeys((1, UNSPECIFIED, 4, 5, 6, 7), SRGB) | {
    9: (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),  # BT.2020
    11: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.314, 0.351),  # DCI-P3
    12: (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),  # Display P3
}
CHUNKS = 64  # of a PNG, at most, that are searched before its pixels


def as_srgb(image: Image.Image, coded: tuple[float, Any] | None, tell: Tell) -> Image.Image:
    """Return the colours of an image as RGB for a display, without transparency.

    coded: from `coded_as`; tell: is told what cannot be done.
    """
    profile, exif = image.info.get("icc_profile"), image.getexif()
    if profile and coded is None:
        plain = image if image.mode in ("L", "CMYK", "LAB") else image.convert("RGB")
        try:
            transform = _transform(profile, plain.mode)
            return plain.convert("RGB") if transform is None else transform.apply(plain)
        except (ImageCms.PyCMSError, OSError, ValueError):
            tell("its colour profile cannot be used, and sRGB is taken")
    rgb = image.convert("RGB")
    parts = exif.get_ifd(ExifTags.IFD.Exif)  # Pillow before 13 raises KeyError for one that is not there
    interop = exif.get_ifd(ExifTags.IFD.Interop) if ExifTags.IFD.Interop in parts else {}
    if coded is None and not profile and interop.get(1) == "R03":  # as cameras mark Adobe RGB
        coded = -563 / 256, ADOBE
    return rgb if coded is None else Image.fromarray(to_srgb(np.asarray(rgb), *coded, tell))


@lru_cache(maxsize=8)
def _transform(profile: bytes, mode: str) -> Any:
    """Return the transform of images from a profile to sRGB; None if it would change nothing."""
    source, target = ImageCms.ImageCmsProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    transform = ImageCms.buildTransform(source, target, mode, "RGB", intent, flags)
    if mode != "RGB":
        return transform
    shades = np.stack(np.meshgrid(*[np.arange(0, 256, 51)] * 3), -1).astype(np.uint8).reshape(6, 36, 3)
    changed = np.abs(np.asarray(transform.apply(Image.fromarray(shades))) - shades.astype(int))
    return transform if changed.max() > 1 else None


def coded_as(stored: Image.Image) -> tuple[float, Any] | None:
    """Return transfer function and primaries that an undecoded file states; None: sRGB, or a profile."""
    info = stored.info
    if stored.format == "PNG" and (found := _cicp(stored)):
        return found
    if nclx := info.get("nclx_profile"):
        return int(nclx["transfer_characteristics"]), int(nclx["color_primaries"])
    if "icc_profile" in info or "srgb" in info or not 0.01 < info.get("gamma", 0) < 10:
        return None
    x_white, y_white, *primaries = info.get("chromaticity", (*D65, *SRGB[:6]))
    as_displayed = abs(info["gamma"] - 0.45455) < 0.01
    return UNSPECIFIED if as_displayed else -1 / info["gamma"], (*primaries, x_white, y_white)


def _cicp(stored: Any) -> tuple[int, int] | None:
    """Return transfer function and primaries of an opened PNG's chunk cICP, which Pillow ignores."""
    if (file := stored.fp) is None:
        return None
    place = file.tell()
    file.seek(8)
    try:
        for _ in range(CHUNKS):
            size, name = struct.unpack(">I4s", file.read(8))
            if name in (b"cICP", b"IDAT"):
                return tuple(file.read(2)[::-1]) if name == b"cICP" else None
            file.seek(size + 4, io.SEEK_CUR)
        return None
    except struct.error:
        return None
    finally:
        file.seek(place)


def to_srgb(coded: Array, transfer: float, primaries: Any, tell: Tell) -> Array:
    """Return (H, W, 3) uint8 for a display, of uint8 or uint16 by a transfer function and primaries.

    transfer: a number of H.273, or a gamma below 0; primaries: a number, or x and y; tell: reports others.
    """
    gamut = primaries if isinstance(primaries, tuple) else PRIMARIES.get(primaries)
    known = transfer < 0 or transfer in (*AS_DISPLAYED, *GAMMAS, LINEAR, PQ, HLG)
    if gamut is None or not known:
        tell(f"colours of transfer function {transfer:g} and primaries {primaries} are taken as sRGB's")
        gamut, transfer = SRGB, UNSPECIFIED
    most = np.iinfo(coded.dtype).max
    light = _light(np.linspace(0, 1, most + 1), transfer).astype(np.float32)
    matrix = np.linalg.solve(_to_xyz(SRGB), _to_xyz(gamut)).T.astype(np.float32)
    if transfer in AS_DISPLAYED and np.abs(matrix - np.eye(3)).max() < 0.01:
        return coded if most == 255 else ((coded.astype(np.uint32) + 128) // 257).astype(np.uint8)
    shown = np.empty(coded.shape, np.uint8)
    for row in range(0, len(coded), 64):  # a part at a time: floats of a whole photograph fill the memory
        linear = np.clip(light[coded[row : row + 64]] @ matrix, 0, 1)
        bright = 1.055 * linear ** (1 / 2.4) - 0.055
        shown[row : row + 64] = np.rint(255 * np.where(linear <= 0.0031308, 12.92 * linear, bright))
    return shown


def _light(signal: Array, transfer: float) -> Array:
    """Return light, 1 for diffuse white, of signals in [0, 1]."""
    if transfer == HLG:
        high = np.exp((signal - 0.55991073) / 0.17883277) + 0.28466892
        return np.asarray(np.where(signal <= 0.5, 4 * signal**2, high) / 12 / HLG_WHITE)
    if transfer == PQ:
        root = signal ** (1 / 78.84375)
        ratio = np.maximum(root - 0.8359375, 0) / (18.8515625 - 18.6875 * root)
        return np.asarray(ratio ** (1 / 0.1593017578125) / PQ_WHITE)
    if transfer in AS_DISPLAYED:
        return linear_light(signal)
    return np.asarray(signal ** (1.0 if transfer == LINEAR else GAMMAS.get(int(transfer), -transfer)))


def _to_xyz(gamut: tuple[float, ...]) -> Array:
    """Return the matrix from linear RGB to XYZ, in which (1, 1, 1) becomes the white of D65."""
    x, y = np.array(gamut[:6]).reshape(3, 2).T
    columns = np.stack([x, y, 1 - x - y]) / y
    at = gamut[6:]
    white = np.array([at[0] / at[1], 1, (1 - at[0] - at[1]) / at[1]])
    matrix = columns * np.linalg.solve(columns, white)
    return np.diag(np.array([D65[0] / D65[1], 1, (1 - sum(D65)) / D65[1]]) / white) @ matrix
