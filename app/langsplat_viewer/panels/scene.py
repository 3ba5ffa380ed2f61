"""The file: what is open, opening another, saving pictures."""

from pathlib import Path

from imgui_bundle import ImVec2, imgui

from langsplat_viewer import actions
from langsplat_viewer.output import saving
from langsplat_viewer.panels.style import bad, beside, elided, muted, small_wrapped, tip, width_of
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
        for doubt in state.doubts:
            small_wrapped(doubt.partition(":")[0], bad())
            tip(doubt)
    if imgui.button("Open ..."):
        actions.ask_for_file(viewer)
    beside("Save picture")
    if imgui.button("Save picture"):
        saving.save_picture(viewer, Path.cwd())
    beside("Save view")
    if imgui.button("Save view"):
        saving.save_view(viewer, Path.cwd())
    beside("Keys")
    if imgui.button("Keys"):
        actions.toggle_help(viewer)
    if len(state.scenes) > 1:
        _list(viewer)


def _list(viewer: Viewer) -> None:
    """The scenes to switch between; the folder is named too where two have one name."""
    state, side = viewer.state, imgui.get_frame_height()
    imgui.separator_text("Scenes")
    if imgui.begin_child("scenes"):
        shown = None if state.path is None else (state.opening or state.path).absolute()
        names = [path.name for path in state.scenes]
        for number, path in enumerate(state.scenes):
            imgui.push_id(number)
            room = imgui.get_content_region_avail().x - side - imgui.get_style().item_spacing.x
            name = path.name if names.count(path.name) == 1 else f"{path.parent.name}/{path.name}"
            name = elided(name, room, width_of)
            imgui.align_text_to_frame_padding()
            if imgui.selectable(f"{name}##scene", path == shown, size=ImVec2(room, 0))[0]:
                actions.switch_scene(viewer, path)
            tip(str(path))
            imgui.same_line(room + imgui.get_style().item_spacing.x)
            imgui.begin_disabled(path == shown)
            if imgui.button("x", ImVec2(side, 0)):
                actions.unlist_scene(viewer, path)
            imgui.end_disabled()
            imgui.pop_id()
    imgui.end_child()


def _figures(viewer: Viewer) -> str:
    scene = viewer.state.scene
    assert scene is not None
    parts = [f"{len(scene.gaussians):,} Gaussians", f"SH {scene.gaussians.sh_degree}"]
    if scene.cameras:
        parts.append(f"{len(scene.cameras)} cameras")
    parts.append("no language field" if scene.language is None else "searchable")
    return ", ".join(parts)
