"""EXIF data of photographs: the focal length, as COLMAP learns of it, and the place (GPS)."""

import math
from pathlib import Path
from typing import Any

from PIL.Image import Exif

from langsplat_core.io.hostile import PictureError, opened

EXIF_IFD, GPS_IFD = 0x8769, 0x8825
_MAKER, _MODEL = 0x010F, 0x0110
_FOCAL, _FOCAL_ON_FILM = 0x920A, 0xA405  # mm; mm of a lens with the same view on film of 36 x 24 mm
_PLANE_X, _PLANE_UNIT, _WIDTH = 0xA20E, 0xA210, 0xA002  # pixels per unit on the sensor; the unit; pixels
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}  # of the unit
_PLAUSIBLE = (1, 5_000)  # mm on film, of any lens that is sold
_NORTH_OR_SOUTH, _LATITUDE, _EAST_OR_WEST, _LONGITUDE = 1, 2, 3, 4


def optics(path: Path) -> Exif:
    """Return EXIF data that tell the focal length alone.

    Other tags, orientation first of all, would be wrong for a copy of the photograph. Where a camera gives
    pixels per inch of its sensor instead of the length on film, that is worked out: COLMAP compares those
    with the size of the image, which is another for a copy.
    """
    kept = Exif()
    try:
        with opened(path) as image:
            source = image.getexif()
            kept.update({tag: source[tag] for tag in (_MAKER, _MODEL) if tag in source})
            inner = source.get_ifd(EXIF_IFD)
            lens = {tag: inner[tag] for tag in (_FOCAL, _FOCAL_ON_FILM) if tag in inner}
            if not lens.get(_FOCAL_ON_FILM):
                lens |= _on_film(inner, image.size)
            kept.get_ifd(EXIF_IFD).update(lens)
            kept.tobytes()
    except PictureError:
        return Exif()
    return kept


def _on_film(inner: dict[int, Any], size: tuple[int, int]) -> dict[int, int]:
    """Return the focal length on film, from the one on a sensor whose pixels are counted by the inch.

    size: (width, height) of the image, px
    """
    try:
        width = inner.get(_WIDTH, size[0]) * _MILLIMETRES[inner.get(_PLANE_UNIT, 2)] / inner[_PLANE_X]
        diagonal = width * math.hypot(*size) / size[0]
        length = float(inner[_FOCAL] / diagonal * math.hypot(36, 24))
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # absent, or not what the standard says
        return {}
    known = math.isfinite(length) and _PLAUSIBLE[0] <= length <= _PLAUSIBLE[1]
    return {_FOCAL_ON_FILM: round(length)} if known else {}


def place(path: Path) -> tuple[float, float]:
    """Return latitude and longitude of a photograph, degrees, north and east positive; NaN without them."""
    try:
        with opened(path) as image:
            # What stands behind a PNG's pixels is read by decoding them all.
            tags = image.getexif().get_ifd(GPS_IFD) if image.format != "PNG" or "exif" in image.info else {}
            latitude = _degrees(tags[_LATITUDE]) * {"N": 1, "S": -1}[tags[_NORTH_OR_SOUTH]]
            longitude = _degrees(tags[_LONGITUDE]) * {"E": 1, "W": -1}[tags[_EAST_OR_WEST]]
    # Absent, or not what the standard says.
    except (PictureError, KeyError, TypeError, ValueError, ZeroDivisionError):
        return math.nan, math.nan
    known = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0)
    return (latitude, longitude) if known else (math.nan, math.nan)


def _degrees(parts: tuple[float, float, float]) -> float:
    """Return degrees, minutes and seconds as degrees."""
    degrees, minutes, seconds = map(float, parts)
    return degrees + minutes / 60 + seconds / 3600
