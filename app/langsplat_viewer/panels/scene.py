"""Files: the panels "Scene" and "Train", the file browser, the questions before files are lost."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.config import TrainPreset
from langsplat_core.io.scenes import format_of
from langsplat_viewer.actions import browsing, filming, opening, projects, selecting, settings
from langsplat_viewer.files.disk import FolderEntry, Listing
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Training, Viewer


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
        browsing.ask_for_file(viewer)
    if ui.next_button("Save picture"):
        filming.save_picture(viewer)
    if ui.next_button("Save view"):
        filming.save_view(viewer)
    if ui.next_button("Help"):
        settings.toggle_help(viewer)
    if len(state.scenes) > 1:
        _list(viewer)


def _list(viewer: Viewer) -> None:
    """The scenes to switch between; the folder is named too where two have one name."""
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


# The file browser.

WIDTH_EM, HEIGHT_EM = 40.0, 30.0
UNITS = ("bytes", "kB", "MB", "GB", "TB")


def draw_browser(viewer: Viewer) -> None:
    """Draw the browser: a box for a path, the folders above, what is in this one, and recent scenes."""
    listing = viewer.state.browser
    choice = viewer.state.picks_folder
    title = "Scene to compare with" if viewer.state.picks_beside else "Open a scene"
    title = title if choice is None else choice.title
    _ask_for_popup(title, listing is not None)
    imgui.set_next_window_size(ui.fitting(WIDTH_EM, HEIGHT_EM), imgui.Cond_.appearing)
    shown, stays = imgui.begin_popup_modal(title, True, imgui.WindowFlags_.no_saved_settings)
    if not shown:
        return
    if listing is not None:
        _path_box(viewer)
        _above(viewer, listing.folder)
        _entries(viewer, listing)
        if viewer.state.picks_folder:
            if imgui.button("Take this folder"):
                browsing.choose_folder(viewer, listing.folder)
        elif has_several(listing) and imgui.button("Open all scenes here"):
            browsing.open_all(viewer)
    if not stays or imgui.is_key_pressed(imgui.Key.escape):
        settings.put(viewer.state, browser=None)
    if viewer.state.browser is None:
        imgui.close_current_popup()
    imgui.end_popup()


def _ask_for_popup(title: str, is_wanted: bool) -> None:
    """Have the popup `title` opened in the middle of the window, if it `is_wanted` and not open."""
    if is_wanted and not imgui.is_popup_open(title):
        imgui.open_popup(title)
    centre = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.5, 0.5))


def has_several(listing: Listing) -> bool:
    return sum(entry.is_file and format_of(entry.path) is not None for entry in listing.entries) > 1


def _path_box(viewer: Viewer) -> None:
    if imgui.is_window_appearing():
        viewer.state.drafts.pop("##path", None)
        imgui.set_keyboard_focus_here()
    picks = viewer.state.picks_folder
    hint = "path of a folder" if picks else "path of a scene or folder, or drop files onto the window"
    typed = ui.kept_box(viewer, "##path", hint, "Open")
    if typed is not None:
        browsing.open_typed(viewer, typed)


def _above(viewer: Viewer, folder: Path) -> None:
    for number, parent in enumerate((*reversed(folder.parents), folder)):
        if number:
            imgui.same_line(0, 2)
            if imgui.get_content_region_avail().x < ui.button_width(parent.name):
                imgui.new_line()
        if imgui.small_button(f"{parent.name or parent}##above {number}"):
            browsing.browse(viewer, parent)


def _entries(viewer: Viewer, listing: Listing) -> None:
    picks = viewer.state.picks_folder
    recent = () if picks else viewer.state.preferences.recent
    lines = min(len(recent), 4) + 1 if recent else 0
    below = lines * imgui.get_text_line_height_with_spacing() + 8 * bool(recent)
    below += imgui.get_frame_height_with_spacing() * (bool(picks) or has_several(listing))
    if imgui.begin_child("entries", ImVec2(0, -below), imgui.ChildFlags_.borders):
        if listing.problem:
            ui.small_wrapped(listing.problem, ui.bad())
        elif not listing.entries:
            ui.small_wrapped("no folders here" if picks else "no scenes and no folders here", ui.muted())
        for entry in (entry for entry in listing.entries if not (picks and entry.is_file)):
            _entry(viewer, entry)
        if listing.left_out:
            ui.small_wrapped(f"{listing.left_out:,} more: type a path", ui.muted())
    imgui.end_child()
    if recent:
        imgui.text_colored(ui.muted(), "Recent")
        foot = imgui.get_frame_height_with_spacing() * has_several(listing)
        if imgui.begin_child("recent", ImVec2(0, -foot)):
            for path in recent:
                if imgui.selectable(f"{path}##recent", False)[0]:
                    browsing.open_recent(viewer, path)
        imgui.end_child()


def _entry(viewer: Viewer, entry: FolderEntry) -> None:
    right = imgui.get_content_region_avail().x
    name = entry.path.name if entry.is_file else f"{entry.path.name}/"
    if imgui.selectable(name, False)[0]:
        browsing.choose(viewer, entry)
    if entry.size:
        text = in_words(entry.size)
        imgui.same_line(right - imgui.calc_text_size(text).x)
        imgui.text_colored(ui.muted(), text)


def in_words(size: float) -> str:
    """Bytes as people read them: "1.4 MB"."""
    unit = 0
    while size >= 1000 and unit + 1 < len(UNITS):
        size, unit = size / 1000, unit + 1
    return f"{size:.0f} {UNITS[unit]}" if unit == 0 or size >= 100 else f"{size:.1f} {UNITS[unit]}"


# The bar of a file that has changed.

BAR = (
    ui.FIXED
    | imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
)


def draw_changed(viewer: Viewer, area: ui.Area) -> None:
    state = viewer.state
    if not viewer.watch.changed or state.path is None or state.opening is not None:
        return
    top = ImVec2(area.left + area.width / 2, area.top + hello_imgui.em_size(3))  # below what a tool says
    imgui.set_next_window_pos(top, imgui.Cond_.always, ImVec2(0.5, 0))
    imgui.begin("changed", None, BAR)
    imgui.align_text_to_frame_padding()
    imgui.text_unformatted(f"{state.path.name} has changed on disk")
    imgui.same_line()
    if ui.button("Reload", "Read it again; camera, queries and view settings stay"):
        opening.reload(viewer)
    imgui.same_line()
    if imgui.button("Not now"):
        viewer.watch.dismiss()
    imgui.end()


# The question before deletions are lost.

UNSAVED = "Not saved"


def draw_unsaved(viewer: Viewer) -> None:
    """Ask whether to save, discard or stay; over everything else, while something waits for the answer."""
    leaving = viewer.state.leaving
    _ask_for_popup(UNSAVED, leaving is not None)
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_saved_settings
    if not imgui.begin_popup_modal(UNSAVED, None, flags)[0]:
        return
    if leaving is not None and leaving.film:
        _wait_for_film(viewer)
    elif leaving is not None:
        _ask(viewer, leaving.to)
    if viewer.state.leaving is None:
        imgui.close_current_popup()
    imgui.end_popup()


def _ask(viewer: Viewer, to: str) -> None:
    state = viewer.state
    if state.is_unsaved:
        moved = " and some transformed" if state.session.moves else ""
        count = f"{int(state.marks.deleted.sum()):,} Gaussians"
        imgui.text_unformatted(f"{count} were deleted{moved}, and the scene is not saved so.")
    if state.has_unsaved_notes:
        imgui.text_unformatted("Notes, names, groups or locks are in no project.")
    imgui.text_unformatted(f"Save before {to}?")
    if state.is_unsaved:
        if ui.button("Save", "The scene as a new file, without what was deleted"):
            selecting.save_and_leave(viewer)
        imgui.same_line()
    if ui.button("Save the project", "Everything in one small file; the scene stays as it is"):
        projects.save_and_leave(viewer)
    imgui.same_line()
    if imgui.button("Discard"):
        selecting.discard_and_leave(viewer)
    imgui.same_line()
    if imgui.button("Cancel"):
        selecting.stay(viewer)


def _wait_for_film(viewer: Viewer) -> None:
    work = viewer.recorder.current
    if work is None:
        selecting.discard_and_leave(viewer)
        return
    imgui.text_unformatted("The window closes once this is written.")
    imgui.progress_bar(work[1], ImVec2(-1, 0), work[0])
    if imgui.button("Stop it, and close"):
        selecting.end_at_once(viewer)
    imgui.same_line()
    if imgui.button("Stay"):
        selecting.stay(viewer)


# The panel "Train".

LOSS_EM = 5.0  # height of its plot
PRESETS: dict[TrainPreset, str] = {
    "quick": "minutes on a CPU",
    "good": "a quarter of an hour and more on a CPU",
    "full": "as published: for a GPU",
}


def draw_training(viewer: Viewer) -> None:
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
        browsing.ask_for_dataset(viewer)
    form = replace(form, out=_text_box("Scene", "scene.ply", form.out))
    form = replace(form, encoder=_text_box("Encoder", '"demo", or a folder or hub id of CLIP', form.encoder))
    preset = ui.radio({name: name for name in PRESETS}, form.preset, PRESETS)
    settings.put(viewer.state, training_form=replace(form, preset=preset))
    if imgui.button("Train"):
        browsing.start_training(viewer)
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
        browsing.stop_training(viewer)
    if ui.next_button("Look at it so far"):
        browsing.look_at_training(viewer)
    for line in progress.said[-3:]:
        ui.small_wrapped(line, ui.muted())
