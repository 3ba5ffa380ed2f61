"""The panels "Scene", "Train" and "Messages": what is open, what is being made, and what is going on."""

from dataclasses import replace

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.config import TrainPreset
from langsplat_viewer.actions import opening, saving, settings
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Training, Viewer

BUTTONS: tuple[ui.Verb, ...] = (
    ("Open ...", opening.ask_for_file, ""),
    ("Save picture", saving.save_picture, ""),
    ("Save view", saving.save_view, ""),
    ("Help", settings.toggle_help, ""),
)


def draw(viewer: Viewer) -> None:
    """Draw the panel "Scene": name and figures of the scene, then the buttons."""
    state, scene = viewer.state, viewer.state.scene
    if scene is None:
        imgui.text("Opening ..." if state.opening else "No scene is open")
    else:
        imgui.text(state.path.name if state.path else "scene")
        figures = f"{len(scene.gaussians):,} Gaussians, SH {scene.gaussians.sh_degree}"
        figures += f", {len(scene.cameras)} cameras" if scene.cameras else ""
        figures += ", no language field" if scene.language is None else ", searchable"
        ui.small_wrapped(figures, ui.muted())
        for warning in state.warnings:
            ui.small_wrapped(warning.partition(":")[0], ui.bad())
            ui.tip(warning)
    ui.verbs(viewer, BUTTONS)
    if len(state.scenes) > 1:
        _list(viewer)


def _list(viewer: Viewer) -> None:
    """Draw the scenes to switch between; the folder is named too where two have one name."""
    state = viewer.state
    imgui.separator_text("Scenes")
    shown = None if state.path is None else (state.opening or state.path).absolute()
    names = [path.name for path in state.scenes]
    rows = [
        ui.Row(p.name if names.count(p.name) == 1 else f"{p.parent.name}/{p.name}", p == shown, str(p))
        for p in state.scenes
    ]
    clicked, gone = ui.listed("scenes", rows, keeps_chosen=True)
    if clicked is not None:
        opening.switch_scene(viewer, state.scenes[clicked])
    if gone is not None:
        opening.unlist_scene(viewer, state.scenes[gone])


# Training.

LOSS_EM = 5.0  # height of its plot
PRESETS: dict[TrainPreset, str] = {
    "quick": "minutes on a CPU",
    "good": "a quarter of an hour and more on a CPU",
    "full": "as published: for a GPU",
}


def draw_training(viewer: Viewer) -> None:
    """Draw the panel "Train": its form, or the training under way."""
    if viewer.training is not None:
        _running(viewer, viewer.training)
        return
    state, form = viewer.state, viewer.state.training_form
    dataset = _text_box("Photographs", "a folder, a COLMAP project, transforms.json", form.dataset)
    form = replace(form, dataset=dataset)
    if imgui.button("Browse ..."):
        opening.ask_for_dataset(viewer)
    form = replace(form, out=_text_box("Scene", "scene.ply", form.out))
    form = replace(form, encoder=_text_box("Encoder", '"demo", or a folder or hub id of CLIP', form.encoder))
    preset = ui.radio({name: name for name in PRESETS}, form.preset, PRESETS)
    settings.put(state, training_form=replace(form, preset=preset))
    if imgui.button("Train"):
        opening.start_training(viewer)
    ui.small_wrapped("An interrupted training continues where it stopped.", ui.muted())
    if state.warnings and state.path is not None:
        imgui.separator_text(f"What speaks against {state.path.name}")
        for warning in state.warnings:
            ui.small_wrapped(warning, ui.bad())


def _text_box(label: str, hint: str, text: str) -> str:
    imgui.text(label)
    imgui.set_next_item_width(-1)
    return str(imgui.input_text_with_hint(f"##{label} to train", hint, text)[1])


def _running(viewer: Viewer, process: Training) -> None:
    progress = process.progress
    imgui.text_unformatted(process.out.name)
    if not progress.stages:
        imgui.text_colored(ui.muted(), "starting")
    for label, fraction in list(progress.stages.items()):
        ui.small_wrapped(f"{label}: done" if fraction >= 1 else label, ui.muted())
        if fraction < 1:
            imgui.progress_bar(fraction, ImVec2(-1, 0))
    if len(progress.losses) > 1:
        values = np.array(progress.losses, np.float32)
        size = ImVec2(-1, hello_imgui.em_size(LOSS_EM))
        imgui.plot_lines("##loss", values, scale_min=0.0, graph_size=size)
        ui.tip("How far the pictures are from the photographs, on average: lower is better")
        imgui.text_colored(ui.muted(), f"loss {values[-1]:.4f}, at first {values[0]:.4f}")
    imgui.separator()
    if imgui.button("Stop"):
        process.interrupt()
    if ui.next_button("Look at it so far"):
        opening.look_at_training(viewer)
    for line in progress.said[-3:]:
        ui.small_wrapped(line, ui.muted())


# Messages.


def draw_messages(viewer: Viewer) -> None:
    """Draw progress, messages (the latest first), and backend, time and size of the last image."""
    if viewer.worker.current is not None and ui.stoppable(*viewer.worker.current):
        opening.cancel(viewer)
    line, stats = imgui.get_text_line_height_with_spacing(), viewer.state.stats
    height = max(imgui.get_content_region_avail().y - line, 2 * line)  # however low the panel is
    if imgui.begin_child("messages", ImVec2(0, height)):
        for message in reversed(viewer.state.messages):
            ui.small_wrapped(message.text, ui.bad() if message.is_error else ui.muted())
    imgui.end_child()
    figures = [viewer.state.backend]
    if stats.width:
        figures += [f"{stats.milliseconds:.0f} ms", f"{stats.width} x {stats.height}"]
    selected = int(viewer.state.marks.selected.sum())
    figures += [f"{selected:,} selected"] if selected else []
    imgui.text_colored(ui.muted(), "   ".join(part for part in figures if part))
