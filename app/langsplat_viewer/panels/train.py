"""From photographs to a scene, without leaving the window."""

from dataclasses import replace
from typing import get_args

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.config import TrainPreset
from langsplat_viewer import actions
from langsplat_viewer.panels.style import bad, beside, beside_boxed, muted, small_wrapped, tip
from langsplat_viewer.viewer import Training, Viewer

PRESETS: tuple[TrainPreset, ...] = get_args(TrainPreset)
LOSS_EM = 5.0  # height of its plot
MEANS = {
    "quick": "minutes on a CPU",
    "good": "a quarter of an hour and more on a CPU",
    "full": "as published: for a GPU",
}


def draw(viewer: Viewer) -> None:
    """The form, or what a running training says."""
    training = viewer.training
    if training is None:
        _form(viewer)
    else:
        _running(viewer, training)


def _form(viewer: Viewer) -> None:
    form = viewer.state.training_form
    form = replace(
        form, dataset=_box("Photographs", "a folder, a COLMAP project, transforms.json", form.dataset)
    )
    form = replace(form, out=_box("Scene", "scene.ply", form.out))
    form = replace(form, encoder=_box("Encoder", '"demo", or a folder or hub id of CLIP', form.encoder))
    for number, preset in enumerate(PRESETS):
        if number:
            beside_boxed(preset)
        if imgui.radio_button(preset, form.preset == preset):
            form = replace(form, preset=preset)
        if imgui.is_item_hovered():
            imgui.set_tooltip(MEANS[preset])
    actions.fill_in(viewer, form)
    if imgui.button("Train"):
        actions.start_training(viewer)
    small_wrapped("An interrupted training continues where it stopped.", muted())
    _doubts(viewer)


def _doubts(viewer: Viewer) -> None:
    """What speaks against the scene that is shown, as its training found."""
    state = viewer.state
    if state.doubts and state.path is not None:
        imgui.separator_text(f"What speaks against {state.path.name}")
        for doubt in state.doubts:
            small_wrapped(doubt, bad())


def _box(label: str, hint: str, text: str) -> str:
    imgui.text(label)
    imgui.set_next_item_width(-1)
    return str(imgui.input_text_with_hint(f"##{label} to train", hint, text)[1])


def _running(viewer: Viewer, training: Training) -> None:
    progress = training.progress
    imgui.text_unformatted(training.request.out.name)
    for label, fraction in list(progress.stages.items()):
        small_wrapped(f"{label}: done" if fraction >= 1 else label, muted())
        if fraction < 1:
            imgui.progress_bar(fraction, ImVec2(-1, 0))
    if len(progress.losses) > 1:
        values = np.array(progress.losses, np.float32)
        size = ImVec2(-1, hello_imgui.em_size(LOSS_EM))
        imgui.plot_lines("##loss", values, scale_min=0.0, graph_size=size)
        tip("How far the pictures are from the photographs, on average: lower is better")
        imgui.text_colored(muted(), f"loss {values[-1]:.4f}, at first {values[0]:.4f}")
    imgui.separator()
    imgui.progress_bar(progress.overall, ImVec2(-1, 0), progress.left or "starting")
    if imgui.button("Stop"):
        actions.stop_training(viewer)
    beside("Look at it so far")
    if imgui.button("Look at it so far"):
        actions.look_at_training(viewer)
    for line in progress.said[-3:]:
        small_wrapped(line, muted())
