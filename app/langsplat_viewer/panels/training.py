"""The panel "Train"."""

from dataclasses import replace

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.config import TrainPreset
from langsplat_viewer.actions import opening, settings
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Training, Viewer

LOSS_EM = 5.0  # height of its plot
PRESETS: dict[TrainPreset, str] = {
    "quick": "minutes on a CPU",
    "good": "a quarter of an hour and more on a CPU",
    "full": "as published: for a GPU",
}


def draw(viewer: Viewer) -> None:
    """Draw the panel "Train": its form, or the training under way."""
    process = viewer.training
    if process is None:
        _form(viewer)
    else:
        _running(viewer, process)


def _form(viewer: Viewer) -> None:
    form = viewer.state.training_form
    form = replace(
        form, dataset=_text_box("Photographs", "a folder, a COLMAP project, transforms.json", form.dataset)
    )
    if imgui.button("Browse ..."):
        opening.ask_for_dataset(viewer)
    form = replace(form, out=_text_box("Scene", "scene.ply", form.out))
    form = replace(form, encoder=_text_box("Encoder", '"demo", or a folder or hub id of CLIP', form.encoder))
    preset = ui.radio({name: name for name in PRESETS}, form.preset, PRESETS)
    settings.put(viewer.state, training_form=replace(form, preset=preset))
    if imgui.button("Train"):
        opening.start_training(viewer)
    ui.small_wrapped("An interrupted training continues where it stopped.", ui.muted())
    state = viewer.state
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
    imgui.text_unformatted(process.request.out.name)
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
