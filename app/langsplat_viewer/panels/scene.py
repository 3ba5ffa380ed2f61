"""The panels "Scene", "Display", "Train" and "Messages"."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.config import HeatOf, TrainPreset
from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS, DisplayRow, Drawing
from langsplat_core.query.answers import FLOOR
from langsplat_viewer.actions import opening, settings
from langsplat_viewer.commands import BUTTONS, Button, buttons_of, is_shown
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.rendering.request import AT_RANGE
from langsplat_viewer.viewer import Training, Viewer


def draw_scene(viewer: Viewer) -> None:
    """Draw the panel "Scene": name and figures of the scene, then the buttons."""
    state, seen = viewer.state, viewer.state.open
    if seen is None:
        imgui.text("Opening ..." if state.opening else "No scene is open")
    else:
        imgui.text(seen.path.name)
        figures = f"{state.count:,} Gaussians, SH {seen.scene.gaussians.sh_degree}"
        figures += f", {len(seen.scene.cameras)} cameras" if seen.scene.cameras else ""
        figures += ", searchable" if state.has_field else ", no language field"
        ui.small_wrapped(figures)
        for warning in seen.warnings:
            ui.small_wrapped(warning.partition(":")[0], "bad")
            ui.tip(warning)
    ui.verbs(viewer, "Open a scene ...", "Save picture", "Save view", "First steps")
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


# Displays.

WIDTH_EM = 11.0  # of lists and of sliders of `ui`, where there is room
LEAST_SPAN = 1e-3  # of a heat scale
BACKDROPS = {(grey, grey, grey): name for name, grey in (("Black", 0.0), ("Grey", 0.5), ("White", 1.0))}


HEAT_TIPS: dict[HeatOf, str] = {
    "smooth": "Relevancy within the answer, smoothed along its surface",
    "own": "Each Gaussian's own relevancy within the answer",
    "node": "The mean of each thing or part of the answer",
    "everywhere": "Each Gaussian's own relevancy, in the answer or not",
}


def draw_display(viewer: Viewer) -> None:
    """Draw the panel "Display": what is shown, and how."""
    for _, group in groupby(DISPLAYS.values(), lambda row: row.name if row.by_level else row.needs_query):
        _display_line(viewer, tuple(group))
    _compared(viewer)
    picture, split = viewer.state.session.picture, viewer.state.session.split
    if split.has_line:
        settings.move_line(viewer, ui.slider("Line", split.at, AT_RANGE))
    needs_query = DISPLAYS[picture.display].needs_query
    if needs_query and not viewer.state.shown():
        ui.small_wrapped("no answer is shown: search for something that is here")
    if any(pane.row.drawing is Drawing.HEAT for pane in viewer.state.panes()):
        ui.row("Heat")
        heats = {of: of.capitalize() for of in HEAT_TIPS}
        picture = replace(picture, heat=ui.choice(heats, picture.heat, HEAT_TIPS))
        picture = replace(picture, heat_opacity=ui.slider("Heat opacity", picture.heat_opacity, (0.0, 1.0)))
        picture = replace(picture, heat_scale=_heat_scale(viewer))
    if needs_query:
        picture = replace(picture, dim=ui.slider("Background brightness", picture.dim, (0.0, 1.0)))
    if any(pane.row.uses_map for pane in viewer.state.panes()):
        names = list(COLOUR_MAPS)
        ui.leave_room("Colour map", WIDTH_EM)
        _, chosen = imgui.combo("Colour map", names.index(picture.colour_map), list(names))
        picture = replace(picture, colour_map=names[chosen])
    ui.row("Backdrop")
    flags = imgui.ColorEditFlags_.no_inputs | imgui.ColorEditFlags_.uint8 | imgui.ColorEditFlags_.no_label
    changed, colour = imgui.color_edit3("Backdrop", list(picture.background), flags)
    if changed:
        red, green, blue = (min(max(float(part), 0.0), 1.0) for part in colour)
        picture = replace(picture, background=(red, green, blue))
    ui.tip("What shows where the scene is not")
    imgui.same_line()
    picture = replace(picture, background=ui.choice(BACKDROPS, picture.background))
    picture = replace(picture, transparent=imgui.checkbox("Save without backdrop", picture.transparent)[1])
    ui.tip("Pictures are saved transparent where the scene is not")
    settings.set_picture(viewer, picture)
    viewer.change("settings", **ui.draw_fields(viewer.state.session, "Display"))
    splats = viewer.state.session.splats
    viewer.change("splats", splats=replace(splats, **ui.draw_fields(splats, "Display")))


def _heat_scale(viewer: Viewer) -> tuple[float, float] | None:
    """Return the relevancies at the ends of the colour bar, as set here; None: each answer's own."""
    scale = viewer.state.session.picture.heat_scale
    changed, fixed = imgui.checkbox("Fixed heat scale", scale is not None)
    ui.tip("The same colour means the same relevancy in every answer, image and scene")
    if changed:
        own = [result.heat_range for result in viewer.state.shown_results() if result is not None]
        lows, highs = zip(*own, strict=True) if own else ((FLOOR,), (1.0,))
        return (min(lows), max(highs)) if fixed else None
    if scale is None:
        return None
    ui.leave_room("From, to", WIDTH_EM)
    flags = imgui.SliderFlags_.always_clamp
    changed, low, high = imgui.drag_float_range2("From, to", *scale, 0.002, 0.0, 1.0, "%.3f", "%.3f", flags)
    return (low, high) if changed and high - low > LEAST_SPAN else scale


def _display_line(viewer: Viewer, rows: tuple[DisplayRow, ...]) -> None:
    """Draw displays with the same needs in one row, named first where one has several buttons."""
    state = viewer.state
    buttons: dict[Button | None, str] = {one: one.label for row in rows for one in buttons_of(row)}
    if len(buttons) > len(rows):
        ui.row(rows[0].label)
    shown = next((one for one in buttons if one is not None and is_shown(state, one)), None)
    with ui.disabled(not state.has_field and rows[0].needs_field):
        chosen = ui.choice(buttons, shown)
    if chosen is not None and chosen != shown:
        settings.set_display(viewer, chosen.display, chosen.latent_level)


def _compared(viewer: Viewer) -> None:
    """Draw the choice of the display that is shown beside the main one."""
    state, split = viewer.state, viewer.state.session.split
    second = Button("", split.second, split.second_level if DISPLAYS[split.second].by_level else None)
    shown = {"off": "nothing", "levels": "three levels", "wipe": second.name}.get(split.mode, "")
    if viewer.beside is not None and viewer.beside.state.path is not None:
        shown = viewer.beside.state.path.name
    ui.leave_room("Compare with", WIDTH_EM)
    if not imgui.begin_combo("Compare with", shown):
        return
    off, levels = (partial(settings.compare, mode=mode) for mode in ("off", "levels"))
    rows: list[tuple[str, bool, Callable[[Viewer], None]]] = [("nothing", False, off)]  # which need a field
    for button in BUTTONS:
        wipe = partial(settings.compare, mode="wipe", second=button.display, latent_level=button.latent_level)
        rows.append((button.name, DISPLAYS[button.display].needs_field, wipe))
    rows += [("three levels", True, levels), ("another scene ...", False, opening.ask_for_beside)]
    for label, needs_field, act in rows:
        with ui.disabled(needs_field and not state.has_field):
            if imgui.selectable(label, label == shown)[0]:
                act(viewer)
    imgui.end_combo()


# Training.

CURVE_EM = 4.0  # height of a plot
CURVES = {"psnr": "held-out photographs {:.1f} dB", "loss": "loss {:.4f}"}
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
    if form.gaussians and not form.dataset:
        ui.small_wrapped(f"Which photographs was {Path(form.gaussians).name} made of?", "good")
    form = replace(form, **ui.draw_fields(form, "Train"))
    preset = ui.choice({name: name.capitalize() for name in PRESETS}, form.preset, PRESETS)
    settings.put(state, training_form=replace(form, preset=preset))
    if imgui.button("Train"):
        opening.start_training(viewer)
    if ui.next_button("Photographs ...", "Choose their folder"):
        opening.ask_for_dataset(viewer)
    ui.small_wrapped("The same entries continue an interrupted training.")


def waits_for(process: Training) -> str:
    """Return what a training that begins or stops waits for; "" for one that goes on."""
    if process.interrupted:
        return "stops after its present step; kernels, once per installation, are first compiled to the end"
    return "" if process.progress.stages else "starting"


def _running(viewer: Viewer, process: Training) -> None:
    progress = process.progress
    imgui.text_unformatted(process.out.name)
    if ui.button("Stop", enabled=not process.interrupted):  # above what grows
        process.interrupt()
    if ui.next_button("Look at it so far"):
        opening.look_at_training(viewer)
    if words := waits_for(process):
        ui.small_wrapped(words)
    stages = dict(progress.stages)
    if done := [label for label, fraction in stages.items() if fraction >= 1]:
        ui.small_wrapped(f"done: {', '.join(done)}")
    for label in (label for label in stages if label not in done):
        ui.small_wrapped(": ".join(filter(None, [label, str(progress.left)])))
        with theme.styled(plot_histogram="pressed"):  # its number is read on it
            imgui.progress_bar(stages[label], ImVec2(-1, 0))
    for name, text in CURVES.items():
        if len(curve := progress.curves.get(name, [])) > 1:
            size = ImVec2(-1, hello_imgui.em_size(CURVE_EM))
            imgui.plot_lines(f"##{name}", np.array(curve, np.float32), graph_size=size)
            ui.coloured(text.format(curve[-1]))
    imgui.separator()
    for line in progress.said:
        ui.small_wrapped(line)


# Messages.


def draw_messages(viewer: Viewer) -> None:
    """Draw the panel "Messages", the latest first."""
    if imgui.begin_child("messages"):
        for message in reversed(viewer.state.messages):
            ui.small_wrapped(message.text, "bad" if message.is_error else "soft")
    imgui.end_child()
