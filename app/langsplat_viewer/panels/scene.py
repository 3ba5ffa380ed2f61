"""The file: what is open, opening another, saving pictures."""

import shutil
import sys
from pathlib import Path
from typing import Any

from imgui_bundle import imgui, portable_file_dialogs

from langsplat_viewer import actions, saving
from langsplat_viewer.panels.style import MUTED, small_wrapped
from langsplat_viewer.viewer import Viewer

DIALOG_PROGRAMS = ("zenity", "kdialog", "matedialog", "qarma")  # one of them draws the dialog on Linux


class OpenDialog:
    """The system's own file dialog, asked for its answer once per frame."""

    def __init__(self) -> None:
        self._dialog: Any = None
        self.available = not sys.platform.startswith("linux") or any(map(shutil.which, DIALOG_PROGRAMS))

    def start(self) -> None:
        """Show the dialog unless it is shown already."""
        if self._dialog is None:
            kinds = ["Scenes", "*.ply *.spz *.splat *.ksplat *.sog", "All files", "*"]
            self._dialog = portable_file_dialogs.open_file("Open a scene", str(Path.cwd()), kinds)

    @property
    def is_open(self) -> bool:
        """Whether an answer is waited for."""
        return self._dialog is not None

    def close(self) -> None:
        """Close a dialog that was forgotten: this process would wait for it, without a window."""
        if self._dialog is not None:
            self._dialog.kill()
            self._dialog = None

    def answer(self) -> Path | None:
        """The chosen file, once."""
        if self._dialog is None or not self._dialog.ready(0):
            return None
        chosen, self._dialog = self._dialog.result(), None
        return Path(chosen[0]) if chosen else None


def draw(viewer: Viewer, dialog: OpenDialog) -> None:
    """Name and figures of the scene, then the buttons."""
    state = viewer.state
    if state.scene is None:
        imgui.text("Opening ..." if state.opening else "No scene is open")
    else:
        imgui.text(state.path.name if state.path else "scene")
        small_wrapped(_figures(viewer), MUTED)
    if imgui.button("Open ...") or actions.take_file_wish(viewer):
        imgui.open_popup("open a scene")
    imgui.same_line()
    if imgui.button("Save picture"):
        saving.save_picture(viewer, Path.cwd())
    imgui.same_line()
    if imgui.button("Save view"):
        saving.save_view(viewer, Path.cwd())
    imgui.same_line()
    if imgui.button("Keys"):
        actions.toggle_help(viewer)
    _open_popup(viewer, dialog)
    chosen = dialog.answer()
    if chosen is not None:
        actions.open_scene(viewer, chosen)


def _figures(viewer: Viewer) -> str:
    scene = viewer.state.scene
    assert scene is not None
    parts = [f"{len(scene.gaussians):,} Gaussians", f"SH {scene.gaussians.sh_degree}"]
    if scene.cameras:
        parts.append(f"{len(scene.cameras)} cameras")
    parts.append("no language field" if scene.language is None else "searchable")
    return ", ".join(parts)


def _open_popup(viewer: Viewer, dialog: OpenDialog) -> None:
    if not imgui.begin_popup("open a scene"):
        return
    imgui.text("Path of a scene (or drop the file onto the window)")
    if imgui.is_window_appearing():
        imgui.set_keyboard_focus_here()
    imgui.set_next_item_width(imgui.get_font_size() * 24)
    flags = imgui.InputTextFlags_.enter_returns_true
    entered, typed = imgui.input_text("##path", viewer.state.path_typed, flags)
    actions.type_path(viewer, typed)
    clicked = imgui.button("Open")
    if (entered or clicked) and actions.open_typed(viewer):
        imgui.close_current_popup()
    if dialog.available:
        imgui.same_line()
        if imgui.button("Browse ..."):
            dialog.start()
            imgui.close_current_popup()
    imgui.end_popup()
