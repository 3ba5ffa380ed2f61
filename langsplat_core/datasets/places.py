"""How long a unit of a capture's world is, by the places (GPS) that its photographs name.

A phone's places are metres off, so they do not move the cameras. But distances between far ones say how long
a unit is, where the photographs lie further apart than their places err; which their own spread tells.
"""

import logging
import math
from pathlib import Path

import numpy as np
from PIL.Image import Exif
from scipy.spatial.distance import pdist

from langsplat_core.arrays import Array
from langsplat_core.datasets.capture import Capture
from langsplat_core.parsing.pictures import PictureError, opened

log = logging.getLogger("langsplat")

FEWEST = 5  # photographs that name a place
FAR = 0.5  # of the longest distance between two cameras: pairs that count
MOST_SPREAD = 0.2  # of the median: by which half of the far pairs may differ from each other
_GPS_IFD, _NORTH_OR_SOUTH, _LATITUDE, _EAST_OR_WEST, _LONGITUDE = 0x8825, 1, 2, 3, 4
_EQUATOR, _FLATTENED = 6_378_137.0, 6.694_379_990_14e-3  # of WGS 84: radius in metres, squared eccentricity


def metres_of(capture: Capture) -> float | None:
    """Metres a unit of `capture` by its photographs' places; None where they do not say so surely."""
    places = np.array([place(photo.path) for photo in capture.photos]).reshape(-1, 2)
    named = np.isfinite(places).all(1)
    if named.sum() < FEWEST:
        return None
    eyes = np.array([camera.position for camera in capture.cameras])[named]
    metres = metres_per_unit(eyes, places[named])
    if metres is None:
        log.info("the places (GPS) of %d photographs differ too much to say how long a unit is", named.sum())
    else:
        log.info("a unit is about %.3g m long by the places (GPS) of %d photographs", metres, named.sum())
    return metres


def metres_per_unit(eyes: Array, places: Array) -> float | None:
    """(K, 3) camera positions and (K, 2) latitudes and longitudes in degrees -> the median ratio of distances
    over far pairs; None where a quarter and three quarters of the pairs differ by more than `MOST_SPREAD`.

    Heights are left out, as most cameras know them badly: for a climb as steep as a stair that is an eighth
    too little.
    """
    apart = pdist(eyes)
    far = apart >= FAR * apart.max(initial=0)
    if not apart.any():
        return None
    low, middle, high = np.quantile(pdist(on_the_ground(places))[far] / apart[far], [0.25, 0.5, 0.75])
    sure = middle > 0 and high - low <= MOST_SPREAD * middle
    return float(middle) if sure else None


def on_the_ground(places: Array) -> Array:
    """(K, 2) latitudes and longitudes in degrees -> (K, 2) metres to the east and to the north of the first,
    for places within some kilometres, away from the poles."""
    latitude, longitude = np.radians(places).T
    bend = 1 - _FLATTENED * np.sin(latitude[0]) ** 2
    north = _EQUATOR * (1 - _FLATTENED) / bend**1.5 * (latitude - latitude[0])
    turn = (longitude - longitude[0] + math.pi) % (2 * math.pi) - math.pi  # also over the date line
    return np.stack([_EQUATOR / math.sqrt(bend) * math.cos(latitude[0]) * turn, north], 1)


def place(path: Path) -> tuple[float, float]:
    """Latitude and longitude of a photograph, degrees, north and east positive; NaN where it names none."""
    try:
        with opened(path) as picture:
            # What stands behind a PNG's pixels is read by decoding them all.
            if picture.format != "PNG" or "exif" in picture.info:
                return _place(picture.getexif())
    except PictureError:
        pass
    return math.nan, math.nan


def _place(exif: Exif) -> tuple[float, float]:
    tags = exif.get_ifd(_GPS_IFD)
    try:
        latitude = _degrees(tags[_LATITUDE]) * {"N": 1, "S": -1}[tags[_NORTH_OR_SOUTH]]
        longitude = _degrees(tags[_LONGITUDE]) * {"E": 1, "W": -1}[tags[_EAST_OR_WEST]]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):  # absent, or not what the standard says
        return math.nan, math.nan
    known = abs(latitude) <= 90 and abs(longitude) <= 180 and (latitude, longitude) != (0, 0)
    return (latitude, longitude) if known else (math.nan, math.nan)


def _degrees(parts: tuple[float, float, float]) -> float:
    """Of degrees, minutes and seconds."""
    degrees, minutes, seconds = map(float, parts)
    return degrees + minutes / 60 + seconds / 3600
