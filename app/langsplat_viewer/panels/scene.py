"""The file: what is open, opening another, saving pictures."""

from pathlib import Path

from imgui_bundle import imgui

from langsplat_viewer import actions, saving
from langsplat_viewer.panels.style import muted, small_wrapped
from langsplat_viewer.viewer import Viewer

DIALOG_PROGRAMS = ("zenity", "kdialog", "matedialog", "qarma")  # one of them draws the dialog on Linux


def draw(viewer: Viewer) -> None:
    """Name and figures of the scene, then the buttons."""
    state = viewer.state
    if state.scene is None:
        imgui.text("Opening ..." if state.opening else "No scene is open")
    else:
        imgui.text(state.path.name if state.path else "scene")
        small_wrapped(_figures(viewer), muted())
    if imgui.button("Open ..."):
        actions.ask_for_file(viewer)
    imgui.same_line()
    if imgui.button("Save picture"):
        saving.save_picture(viewer, Path.cwd())
    imgui.same_line()
    if imgui.button("Save view"):
        saving.save_view(viewer, Path.cwd())
    imgui.same_line()
    if imgui.button("Keys"):
        actions.toggle_help(viewer)


def _figures(viewer: Viewer) -> str:
    scene = viewer.state.scene
    assert scene is not None
    parts = [f"{len(scene.gaussians):,} Gaussians", f"SH {scene.gaussians.sh_degree}"]
    if scene.cameras:
        parts.append(f"{len(scene.cameras)} cameras")
    parts.append("no language field" if scene.language is None else "searchable")
    return ", ".join(parts)
