"""What one window leaves for the next: preferences, and the layout of the panels."""

from dataclasses import replace
from pathlib import Path

from imgui_bundle import hello_imgui

from langsplat_core.errors import InputError
from langsplat_viewer.files.preferences import LAYOUT_NAME, Preferences, load_preferences, save_preferences
from langsplat_viewer.jobs import one_line
from langsplat_viewer.panels import style
from langsplat_viewer.state import ViewerState


class Remembered:
    """Keeps a folder and the window's looks in step with the preferences of a `ViewerState`."""

    def __init__(self, folder: Path | None, state: ViewerState) -> None:
        """`folder` None: nothing is read and nothing written."""
        self._folder = folder
        self._state = state
        self._kept: Preferences | None = None  # as they lie on disk; None: they are not kept there
        self._styled: Preferences | None = None  # as the window looks

    def load(self, params: hello_imgui.RunnerParams, restore_size: bool) -> None:
        """Take the preferences that are there, and say where the layout is. Where the folder cannot be
        written or understood, the reason is said and nothing is kept."""
        params.ini_disable = True
        params.app_window_params.restore_previous_geometry = False
        if self._folder is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._state.preferences = load_preferences(self._folder)
        except (OSError, InputError) as error:
            self._state.say(f"settings are not remembered: {one_line(error)}", is_error=True)
            return
        self._kept = self._state.preferences
        self._state.picture = replace(self._state.picture, colour_map=self._kept.colour_map)
        params.ini_disable = False
        params.ini_folder_type = hello_imgui.IniFolderType.absolute_path
        params.ini_filename = str(self._folder / LAYOUT_NAME)
        params.app_window_params.restore_previous_geometry = restore_size

    def style(self) -> None:
        """Make the window look as the preferences say."""
        self._styled = self._state.preferences
        style.apply(self._styled)

    def update(self) -> None:
        """Once per frame: apply and keep what has changed."""
        preferences = self._state.preferences
        if self._styled is not None and preferences != self._styled:
            self.style()
        if self._folder is None or self._kept is None or preferences == self._kept:
            return
        self._kept = preferences
        try:
            save_preferences(self._folder, preferences)
        except OSError as error:
            self._state.say(f"settings not written: {one_line(error)}", is_error=True)
