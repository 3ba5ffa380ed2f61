"""Preferences: choices that outlive a window, kept in the platform's folder for settings.

A field that is added here is kept, and what has a title gets its widget in the panel that is named with it.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np
import platformdirs
from msgspec import Meta

from langsplat_core.config import ColourMap
from langsplat_core.errors import InputError, printable_line
from langsplat_core.io.files import atomic_path

Theme = Literal["dark", "light"]
THEMES: tuple[Theme, ...] = get_args(Theme)
SCALES = (0.75, 3.0)  # least and largest size of letters and widgets
DESIGNED = 1080  # window units: the height of the screen that a scale of 1 is made for
MOST_RECENT = 12
FILE_NAME, LAYOUT_NAME = "preferences.json", "layout.ini"
LARGEST = 1_000_000  # bytes of the file
CAMERA = {"panel": "Camera"}


@dataclass(frozen=True)
class Preferences:
    """The settings that outlive a window."""

    theme: Theme = "dark"
    ui_scale: Annotated[float, Meta(ge=SCALES[0], le=SCALES[1])] = 1.0  # of letters and widgets
    recent: tuple[str, ...] = ()  # scenes that were opened, the latest first
    panels: tuple[str, ...] | None = None  # titles of those that are open; None: those that are at first
    colour_map: ColourMap = "turbo"  # that a session begins with
    overlays: tuple[str, ...] = ()  # that a session begins with
    fly_speed: Annotated[
        float,
        Meta(ge=0.05, le=4, title="Fly speed", description="Scene radii per second", extra=CAMERA),
    ] = 0.5
    coarse_while_moving: Annotated[
        bool,
        Meta(
            title="Coarse while moving",
            description="Where drawing is slow: fewer pixels and merged Gaussians while the camera moves",
            extra=CAMERA,
        ),
    ] = True


def preferences_folder() -> Path:
    """Return the folder of the preferences; it need not exist."""
    return Path(platformdirs.user_config_path("langsplat-viewer", appauthor=False))


def fitting_scale(height: float) -> float:
    """Return the size of letters for a screen `height` units high: at 1080 that of the design."""
    return float(np.clip(round(4 * height / DESIGNED) / 4, 1.0, SCALES[1]))


def load_preferences(folder: Path, at_first: Preferences | None = None) -> Preferences:
    """Read the preferences in `folder`, `at_first` or the defaults where there are none.

    InputError where the file makes no sense.
    """
    path = folder / FILE_NAME
    try:
        return msgspec.json.decode(path.read_bytes()[:LARGEST], type=Preferences)
    except FileNotFoundError:
        return at_first or Preferences()
    except (OSError, ValueError, RecursionError) as error:
        reason = printable_line(getattr(error, "strerror", None) or error, 120)
        raise InputError(f"{path}: {reason}; the defaults are used; mend or delete it") from None


def save_preferences(folder: Path, preferences: Preferences) -> None:
    """Write the preferences, whole or not at all. OSError where the folder cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / FILE_NAME) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(preferences), indent=1))


def with_recent(preferences: Preferences, path: Path) -> Preferences:
    """Return the preferences with `path` as the scene that was opened last."""
    name = str(path)
    others = tuple(other for other in preferences.recent if other != name)
    return replace(preferences, recent=(name, *others)[:MOST_RECENT])
