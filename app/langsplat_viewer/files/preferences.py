"""Preferences: choices that outlive a window, kept in the platform's folder for settings."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import platformdirs

from langsplat_core.config import ColourMap
from langsplat_core.errors import InputError, printable_line
from langsplat_core.io.files import atomic_path

Theme = Literal["dark", "light"]
THEMES: tuple[Theme, ...] = get_args(Theme)
SCALES = (0.75, 3.0)  # least and largest size of letters and widgets
DESIGNED = 1080  # window units: the height of the screen that a scale of 1 is made for
MOST_RECENT = 12
MOST_FOLDERS = 100  # scenes whose folder of photographs is remembered
FILE_NAME, LAYOUT_NAME = "preferences.json", "layout.ini"
LARGEST = 1_000_000  # bytes of the file
_LISTS = {"recent", "panels", "overlays"}


@dataclass(frozen=True)
class Preferences:
    """The settings that outlive a window."""

    theme: Theme = "dark"
    ui_scale: float = 1.0  # of letters and widgets, within `SCALES`
    recent: tuple[str, ...] = ()  # scenes that were opened, the latest first
    panels: tuple[str, ...] | None = None  # titles of those that are open; None: those that are at first
    colour_map: ColourMap = "turbo"  # of relevancy and depth
    overlays: tuple[str, ...] = ()  # of `state.OVERLAYS`, those that lie over the scene
    photographs: dict[str, str] = field(default_factory=dict)  # scene -> folder; the latest chosen last

    def __post_init__(self) -> None:
        if self.theme not in THEMES:
            raise InputError(f'theme "{printable_line(self.theme, 40)}"; there are {", ".join(THEMES)}')
        if self.colour_map not in get_args(ColourMap):
            known = ", ".join(get_args(ColourMap))
            raise InputError(f'colour_map "{printable_line(self.colour_map, 40)}"; there are {known}')
        is_number = isinstance(self.ui_scale, int | float) and not isinstance(self.ui_scale, bool)
        if not (is_number and SCALES[0] <= self.ui_scale <= SCALES[1]):
            raise InputError(f"ui_scale is not a number from {SCALES[0]} to {SCALES[1]}")
        for name in _LISTS:
            if not _are_texts(getattr(self, name) or ()):
                raise InputError(f"{name} is not a list of texts")
        if not (isinstance(self.photographs, dict) and _are_texts(self.photographs.values())):
            raise InputError("photographs is not an object of texts")


def _are_texts(values: Iterable[object]) -> bool:
    return all(isinstance(value, str) for value in values)


def preferences_folder() -> Path:
    """Return the folder of the preferences; it need not exist."""
    return Path(platformdirs.user_config_path("langsplat-viewer", appauthor=False))


def fitting_scale(height: float) -> float:
    """The size of letters for a screen `height` units high: at 1080 that of the design."""
    return float(np.clip(round(4 * height / DESIGNED) / 4, 1.0, SCALES[1]))


def load_preferences(folder: Path, at_first: Preferences | None = None) -> Preferences:
    """Read the preferences in `folder`, `at_first` or the defaults where there are none. InputError where the
    file makes no sense."""
    path = folder / FILE_NAME
    try:
        text = path.read_bytes()[:LARGEST]
        return _from_json(json.loads(text))
    except FileNotFoundError:
        return at_first or Preferences()
    except (OSError, ValueError, RecursionError, InputError) as error:
        reason = printable_line(getattr(error, "strerror", None) or error, 120)
        raise InputError(f"{path}: {reason}; the defaults are used; mend or delete it") from None


def _from_json(top: Any) -> Preferences:
    if not isinstance(top, dict):
        raise InputError("no JSON object")
    known = {row.name for row in fields(Preferences)}
    values = {name: value for name, value in top.items() if name in known}  # a later version may add some
    for name in _LISTS & values.keys():
        if isinstance(values[name], list):
            values[name] = tuple(values[name])
        elif values[name] is not None or name != "panels":
            raise InputError(f"{name} is not a list of texts")
    return Preferences(**values)


def save_preferences(folder: Path, preferences: Preferences) -> None:
    """Write the preferences, whole or not at all. OSError where the folder cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / FILE_NAME) as temporary:
        temporary.write_text(json.dumps(asdict(preferences), indent=1), encoding="utf-8")


def with_recent(preferences: Preferences, path: Path) -> Preferences:
    """Return the preferences with `path` as the scene that was opened last."""
    name = str(path)
    others = tuple(other for other in preferences.recent if other != name)
    return replace(preferences, recent=(name, *others)[:MOST_RECENT])


def with_photographs(preferences: Preferences, scene: Path, folder: Path) -> Preferences:
    """Return the preferences with `folder` as the one that has the photographs of `scene`."""
    others = {path: kept for path, kept in preferences.photographs.items() if path != str(scene)}
    latest = list(others.items())[1 - MOST_FOLDERS :]
    return replace(preferences, photographs={**dict(latest), str(scene): str(folder)})
