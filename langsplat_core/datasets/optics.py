"""What a photograph's EXIF data say of its lens, as COLMAP takes it from a smaller copy."""

import math
from pathlib import Path
from typing import Any

from PIL import Image

from langsplat_core.parsing.pictures import PictureError, opened

_MAIN_TAGS, _EXIF_IFD = (0x010F, 0x0110), 0x8769  # maker, model
_FOCAL, _FOCAL_ON_FILM = 0x920A, 0xA405  # mm; mm of a lens with the same view on film of 36 x 24 mm
_PLANE_X, _PLANE_UNIT, _WIDTH = 0xA20E, 0xA210, 0xA002  # pixels per unit on the sensor; the unit; pixels
_MILLIMETRES = {2: 25.4, 3: 10.0, 4: 1.0}  # of the unit
_FILM = math.hypot(36, 24)  # mm, its diagonal
_PLAUSIBLE = (1, 5_000)  # mm on film, of any lens that is sold


def optics(path: Path) -> Image.Exif:
    """Only what tells the focal length: other tags, orientation first of all, would be wrong for a copy.

    Where a camera gives pixels per inch of its sensor instead of the length on film, that is worked out:
    COLMAP compares those with the size of the picture, which is another for a copy.
    """
    kept = Image.Exif()
    try:
        with opened(path) as picture:
            source = picture.getexif()
            kept.update({tag: source[tag] for tag in _MAIN_TAGS if tag in source})
            inner = source.get_ifd(_EXIF_IFD)
            kept_inner = {tag: inner[tag] for tag in (_FOCAL, _FOCAL_ON_FILM) if tag in inner}
            if not kept_inner.get(_FOCAL_ON_FILM):
                kept_inner |= _on_film(inner, picture.size)
            kept.get_ifd(_EXIF_IFD).update(kept_inner)
            kept.tobytes()
    except PictureError:
        return Image.Exif()
    return kept


def _on_film(inner: dict[int, Any], size: tuple[int, int]) -> dict[int, int]:
    """The focal length on film from the one on a sensor whose pixels are counted by the inch; `size`: of the
    picture, pixels."""
    try:
        width = inner.get(_WIDTH, size[0]) * _MILLIMETRES[inner.get(_PLANE_UNIT, 2)] / inner[_PLANE_X]
        diagonal = width * math.hypot(*size) / size[0]
        length = float(inner[_FOCAL] / diagonal * _FILM)
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # absent, or not what the standard says
        return {}
    known = math.isfinite(length) and _PLAUSIBLE[0] <= length <= _PLAUSIBLE[1]
    return {_FOCAL_ON_FILM: round(length)} if known else {}


def tags(exif: Image.Exif) -> dict[int, object]:
    """All of them, the inner ones too."""
    return dict(exif) | dict(exif.get_ifd(_EXIF_IFD))
