"""The panel "Scene"."""

from imgui_bundle import imgui

from langsplat_viewer.actions import opening, saving, settings
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Viewer


def draw(viewer: Viewer) -> None:
    """Draw the panel "Scene": name and figures of the scene, then the buttons."""
    state = viewer.state
    if state.scene is None:
        imgui.text("Opening ..." if state.opening else "No scene is open")
    else:
        imgui.text(state.path.name if state.path else "scene")
        ui.small_wrapped(_figures(viewer), ui.muted())
        for warning in state.warnings:
            ui.small_wrapped(warning.partition(":")[0], ui.bad())
            ui.tip(warning)
    if imgui.button("Open ..."):
        opening.ask_for_file(viewer)
    if ui.next_button("Save picture"):
        saving.save_picture(viewer)
    if ui.next_button("Save view"):
        saving.save_view(viewer)
    if ui.next_button("Help"):
        settings.put(state, show_help=not state.show_help)
    if len(state.scenes) > 1:
        _list(viewer)


def _list(viewer: Viewer) -> None:
    """Draw the scenes to switch between; the folder is named too where two have one name."""
    state = viewer.state
    imgui.separator_text("Scenes")
    if imgui.begin_child("scenes"):
        shown = None if state.path is None else (state.opening or state.path).absolute()
        names = [path.name for path in state.scenes]
        for number, path in enumerate(state.scenes):
            imgui.push_id(number)
            name = path.name if names.count(path.name) == 1 else f"{path.parent.name}/{path.name}"
            clicked, gone = ui.row(name, "scene", path == shown, can_go=path != shown, about=str(path))
            if clicked:
                opening.switch_scene(viewer, path)
            if gone:
                opening.unlist_scene(viewer, path)
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
