"""Start page, toasts and dialogs over the scene: files, exports, changed files, unsaved work."""

import os
import shutil
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from os.path import exists
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
from imgui_bundle import ImVec2, hello_imgui, icons_fontawesome_6, imgui, imgui_ctx
from imgui_bundle import portable_file_dialogs as pfd

from langsplat_core.errors import LangSplatError
from langsplat_core.io.hostile import opened
from langsplat_core.io.scenes import formats
from langsplat_core.progress import Progress
from langsplat_viewer.actions import editing, opening, saving, settings
from langsplat_viewer.disk import path_completions
from langsplat_viewer.jobs import Worker
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.projects import BUNDLED, PATHS, PROJECTS, thumbnail_of
from langsplat_viewer.state import ExportForm, FileChoice, Message
from langsplat_viewer.viewer import Viewer

# The start page.

CARD_EM, PICTURE_EM, DROP_EM = 14.5, 8.5, 4.0  # width of a card; heights
MOST_WIDE, MOST_COLUMNS, TITLE_SIZE = 0.95, 4, 1.8  # of the area; cards beside each other; of letters


class StartPage:
    """The page shown without a scene: recent files and ways to begin."""

    def __init__(self, folder: Path | None) -> None:
        """`folder`: of the preferences, with the thumbnails."""
        self._folder = folder
        self._cards: list[tuple[Path, np.ndarray | None]] = []
        self._pictures = defaultdict[int, ui.Picture](ui.Picture)  # by the places of the cards

    def _look_up(self, viewer: Viewer) -> None:
        """List the bundled scene and the recent files that are there, each with its thumbnail."""
        for path in dict.fromkeys((BUNDLED, *map(Path, filter(exists, viewer.state.preferences.recent)))):
            kept, image = thumbnail_of(self._folder, path), None
            if kept is not None:
                with suppress(LangSplatError), opened(kept) as file:
                    image = np.asarray(file.convert("RGB"))
            self._cards.append((path, image))

    def draw(self, viewer: Viewer, area: ui.Area) -> None:
        """Draw it over the scene's area, while it is wanted."""
        if not viewer.state.show_start:
            self._cards = []
            return
        if not self._cards:
            self._look_up(viewer)
            imgui.set_next_window_focus()  # for Tab, arrows and Enter
        gap, card = imgui.get_style().item_spacing.x, hello_imgui.em_size(CARD_EM)
        columns = min(max(int((MOST_WIDE * area.width + gap) / (card + gap)), 1), MOST_COLUMNS)
        width = columns * (card + gap) - gap
        imgui.set_next_window_pos(ImVec2(area.left, area.top))
        imgui.set_next_window_size(ImVec2(area.width, area.height))
        imgui.set_next_window_bg_alpha(1.0)
        with theme.styled(window_padding=ImVec2(max(area.width - width, 0) / 2, 0)):
            imgui.begin("start", None, (ui.OVER | ui.FIXED) & ~imgui.WindowFlags_.no_scrollbar)
        imgui.dummy(ImVec2(0, 0.04 * area.height))
        imgui.push_font(imgui.get_font(), TITLE_SIZE * theme.FONT_SIZE)
        imgui.text_unformatted("LangSplat viewer")
        imgui.pop_font()
        ui.small_wrapped("Look around in 3D Gaussian scenes, and search them with words.")
        imgui.dummy(ImVec2(0, hello_imgui.em_size(0.4)))
        with theme.styled(frame_padding=hello_imgui.em_to_vec2(0.8, 0.45)):
            ui.verbs(viewer, "Open a scene ...", "Train from photographs ...", "First steps")
        imgui.dummy(ImVec2(0, hello_imgui.em_size(0.8)))
        for number, (path, image) in enumerate(self._cards):
            if number % columns:
                imgui.same_line()
            with imgui_ctx.push_id(str(number)):
                if _card(path, None if image is None else self._pictures[number].texture(image), card):
                    opening.open_file(viewer, path)
        imgui.dummy(ImVec2(0, hello_imgui.em_size(0.4)))
        work, text = viewer.worker.current, "Drop a scene, a project or a folder of photographs here"
        text = f"{work[0]} ..." if viewer.state.opening and work else text
        with ui.disabled(True):  # files are taken all over the window
            imgui.button(text, ImVec2(width, hello_imgui.em_size(DROP_EM)))
        imgui.end()


def _card(path: Path, texture: moderngl.Texture | None, width: float) -> bool:
    """Draw the card of a file, its image over its name; return whether it was clicked."""
    height, name, where = hello_imgui.em_size(PICTURE_EM), path.name, str(path.parent)
    if path == BUNDLED:
        name, where = "A room to try", "comes with the program"
    with imgui_ctx.begin_group():
        if texture is None:
            clicked = imgui.button(f"{icons_fontawesome_6.ICON_FA_CUBES}###card", ImVec2(width, height))
        else:
            edge = imgui.get_style().frame_padding
            inside = ImVec2(width - 2 * edge.x, height - 2 * edge.y)
            clicked = imgui.image_button("###card", imgui.ImTextureRef(texture.glo), inside)
        ui.tip(str(path))
        imgui.text_unformatted(ui.elided(name, width))
        ui.coloured(ui.elided(where, width))
    return bool(clicked)


# Toasts: the latest messages, for some seconds.

TOAST_EM, BAR_EM, MOST_TOASTS = 30.0, 20.0, 3


class Toasts:
    """The latest messages, over the scene for some seconds, or until the window is drawn again after that."""

    def __init__(self) -> None:
        self.seconds = 6.0
        self.shown: list[tuple[Message, float]] = []  # and since when
        self._said: list[Message] = []  # as they were in the last frame

    def draw(self, viewer: Viewer, area: ui.Area, read: str) -> None:
        """Draw all but what is `read` in a panel; one that is pointed at stays, a click sends them away."""
        now, said = imgui.get_time(), viewer.state.messages
        new = [message for message in said if all(message is not known for known in self._said)]
        self._said = said
        earlier = (one for one in self.shown if one[0] not in new)  # the same is not said twice
        since = (*earlier, *((message, now) for message in new if message.text != read))
        self.shown = [(message, at) for message, at in since if now - at < self.seconds][-MOST_TOASTS:]
        writes = viewer.recorder.current
        if not self.shown and writes is None:
            return
        foot = ImVec2(area.left + area.width / 2, area.top + area.height - hello_imgui.em_size(2))
        widest = min(hello_imgui.em_size(TOAST_EM), 0.8 * area.width)
        for low, high in ui.floating_windows("legend", "left legend"):  # which are not to be covered
            if low.x - widest / 2 < foot.x < high.x + widest / 2:
                foot.y = min(foot.y, low.y - hello_imgui.em_size(0.5))
        flags = ui.FLOATS & ~imgui.WindowFlags_.no_bring_to_front_on_focus | imgui.WindowFlags_.no_nav
        with ui.floating("toasts", foot, ImVec2(0.5, 1), flags):
            with imgui_ctx.push_text_wrap_pos(widest):
                for number, (message, _) in enumerate(self.shown):
                    with imgui_ctx.push_id(str(number)):
                        self._toast(viewer, message)
            wide = min(BAR_EM, widest / hello_imgui.em_size(1) - 5)  # beside Cancel
            if writes is not None and ui.stoppable(*writes, wide, "##recorder"):
                viewer.recorder.cancel(waiting=False)
                viewer.state.say("stopped: no file was written, a folder keeps those written so far")
            if imgui.is_window_hovered():
                self.shown = [(message, now) for message, _ in self.shown]
                if imgui.is_mouse_clicked(0) and not imgui.is_any_item_hovered():
                    self.shown = []

    def _toast(self, viewer: Viewer, message: Message) -> None:
        ui.coloured(message.text, "bad" if message.is_error else "ink")
        if message.file is not None and imgui.small_button("Show in folder"):
            saving.show_in_folder(viewer, message.file)
        is_last = message.undoes is not None and [message.undoes] == viewer.history.past[-1:]
        if is_last and imgui.small_button("Undo"):
            editing.undo(viewer)
            self.shown = []


# Dialogs.


def _begin_modal(title: str, is_wanted: bool, width: float) -> bool:
    """Begin a dialog so many widths of an m wide while it `is_wanted`; return whether it is drawn."""
    if is_wanted and not imgui.is_popup_open(title):
        imgui.open_popup(title)
    centre = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.5, 0.5))
    imgui.set_next_window_size(ImVec2(ui.fitting(width, 1).x, 0))
    flags = imgui.WindowFlags_.no_saved_settings | imgui.WindowFlags_.no_resize
    return bool(imgui.begin_popup_modal(title, None, flags)[0])


def _end_modal(viewer: Viewer, name: str, cancel: str = "Cancel") -> None:
    """End it with a button that empties its field of the state, as Esc does; without that it closes."""
    if ui.next_button(cancel):
        settings.put(viewer.state, **{name: None})
    if getattr(viewer.state, name) is None:
        imgui.close_current_popup()
    imgui.end_popup()


# Files and folders: by the dialogs of the system, else by a path.

BOX_EM, MOST_ROWS, ABOVE = 34.0, 8.5, ".. (the folder above)"
HELPERS = ("zenity", "kdialog", "matedialog", "qarma")  # programs that show dialogs on Linux


def system_dialog(choice: FileChoice) -> Any:
    """Open the dialog of the system, as `portable_file_dialogs` has them; None where nothing shows one."""
    if sys.platform.startswith("linux") and not any(map(shutil.which, HELPERS)):
        return None
    within = f"{choice.start}{os.sep}"
    if choice.kind == "folder":
        return pfd.select_folder(choice.title, within)
    filters = [choice.title, " ".join(f"*{suffix}" for suffix in _offered(choice)), "All files", "*"]
    if choice.kind == "save":
        return pfd.save_file(choice.title, str(choice.start), filters)
    return pfd.open_file(choice.title, within, filters)


def _offered(choice: FileChoice) -> tuple[str, ...]:
    """Return the endings of files that are offered; none where a folder is wanted."""
    if choice.kind != "open":
        return choice.suffixes or ("/",)  # which no name of a file has
    names = (name for row in formats() for name in (row.suffix, row.folder_file) if name)
    return (*names, PROJECTS, PATHS)


class FileDialogs:
    """Asks for files and folders; no frame waits for the system."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self.open_system: Callable[[FileChoice], Any] = system_dialog
        self._choice: FileChoice | None = None
        self._dialog: Any = None  # of the system
        self._waiting = Worker(wake)

    def close(self) -> None:
        """Close the dialog of the system, which would keep the process."""
        if self._dialog is not None:
            self._waiting.cancel()
            self._dialog.kill()
            self._dialog = None

    def draw(self, viewer: Viewer) -> None:
        """Draw the dialog that is wanted, or a note that it is a window of the system."""
        self._waiting.poll()
        choice = viewer.state.choice
        if choice is not self._choice:
            self._begin(viewer, choice)
        title = "Choose" if choice is None else choice.title
        if not _begin_modal(f"{title}###choice", choice is not None, BOX_EM):
            return
        if choice is not None and self._dialog is None:
            _path_box(viewer, choice)
        else:
            imgui.text_wrapped("Choose in the window that the system has opened.")
        _end_modal(viewer, "choice")

    def _begin(self, viewer: Viewer, choice: FileChoice | None) -> None:
        self.close()
        self._choice = choice
        if choice is None:
            return
        drafts, self._dialog = viewer.state.drafts, self.open_system(choice)
        drafts["##path"], dialog = choice.start.name if choice.kind == "save" else "", self._dialog

        def wait(progress: Progress) -> str:
            while not dialog.ready(0):
                time.sleep(0.05)
            found = dialog.result()
            return found if isinstance(found, str) else "".join(found[:1])

        def done(path: str) -> None:
            settings.choose(viewer, path, is_confirmed=True)
            settings.put(viewer.state, choice=None)

        if dialog is not None:
            self._waiting.submit(choice.title, wait, done, viewer.say_error)


def _path_box(viewer: Viewer, choice: FileChoice) -> None:
    """Draw a box for a path, and what the disk has that begins so, and the folder above."""
    saves, drafts = choice.kind == "save", viewer.state.drafts
    folder = choice.start.parent if saves else choice.start
    ui.coloured(ui.elided(f"in {folder}", imgui.get_content_region_avail().x))
    if imgui.is_window_appearing():
        imgui.set_keyboard_focus_here()
    hint = "path of a folder" if choice.kind == "folder" else "path; or drop a file onto the window"
    if (typed := ui.kept_box(viewer, "##path", hint, "Save" if saves else "Open")) is not None:
        settings.choose(viewer, typed)
        drafts["##path"] = typed
    offers = path_completions(drafts.get("##path", ""), folder, _offered(choice))
    below = imgui.get_main_viewport().size.y - imgui.get_cursor_screen_pos().y
    rows = below / imgui.get_frame_height_with_spacing() - 2  # the last row is that of Cancel
    if ui.begin_list("offers", max(min(MOST_ROWS, rows), 2)):
        for offer in offers[saves:]:  # a name to save under stays when folders are looked through
            name = Path(offer).name + os.sep * offer.endswith(os.sep) if offer != offers[0] else ABOVE
            if imgui.selectable(name, False, imgui.SelectableFlags_.no_auto_close_popups)[0]:
                drafts["##path"] = offer
    imgui.end_child()


# Exports.

EXPORT_EM = 27.0


def draw_export(viewer: Viewer) -> None:
    """Draw the dialog that exports: what, its options, and about how large it will be."""
    form = viewer.state.export_form
    if _begin_modal("Export", form is not None, EXPORT_EM):
        if form is not None:
            _export(viewer, form)
        _end_modal(viewer, "export_form")


def _export(viewer: Viewer, form: ExportForm) -> None:
    titles = saving.exports()
    imgui.set_next_item_width(-1)
    changed, chosen = imgui.combo("##what", titles.index(form.title), [*map(str.capitalize, titles)])
    if changed:
        saving.ask_export(viewer, titles[chosen])
        return
    row, values = saving.EXPORTS[form.title], dict(form.values)
    ui.small_wrapped(row.about)
    suffix, only = form.suffix, form.only_selected
    if len(row.sizes) > 1:
        suffix = ui.choice({name: name for name in row.sizes}, suffix)
    for flag, value in values.items():
        label, default, limits = saving.OPTIONS[flag]
        if default is False:
            values[flag] = imgui.checkbox(label, bool(value))[1]
        else:
            values[flag] = ui.slider(label, value, limits, "%.3g", logarithmic=True)
    selected = int(viewer.state.marks.selected.sum())
    if selected or only:
        only = imgui.checkbox(f"Only the selection ({selected:,} Gaussians)", only)[1]
    form = replace(form, suffix=suffix, values=values, only_selected=only)
    settings.put(viewer.state, export_form=form)
    imgui.text_unformatted(f"{saving.export_size(viewer, form)} on disk")
    if ui.button("Export ...", enabled=bool(saving.exported(viewer, form).any())):
        saving.choose_export(viewer, form)


# A file that has changed.


def draw_changed(viewer: Viewer, area: ui.Area) -> None:
    """Draw the bar of a file that has changed."""
    state = viewer.state
    if not viewer.watch.changed or state.path is None or state.opening is not None:
        return
    top = ImVec2(area.left + area.width / 2, area.top + hello_imgui.em_size(3))  # below what a tool says
    with ui.floating("changed", top, ImVec2(0.5, 0), ui.FLOATS | imgui.WindowFlags_.no_nav):
        imgui.align_text_to_frame_padding()
        imgui.text_unformatted(f"{state.path.name} has changed on disk")
        imgui.same_line()
        if ui.button("Reload", "Read it again; camera, queries and view settings stay"):
            opening.reload(viewer)
        imgui.same_line()
        if imgui.button("Not now"):
            viewer.watch.dismiss()


# Unsaved work.

LEAVING_EM = 32.0


def draw_unsaved(viewer: Viewer) -> None:
    """Ask whether to save, discard or stay; over everything else, while something waits for the answer."""
    leaving = viewer.state.leaving
    if _begin_modal("Not saved", leaving is not None, LEAVING_EM):
        if leaving is not None and leaving.film:
            _wait_for_film(viewer)
        elif leaving is not None:
            _ask(viewer, leaving.to)
        _end_modal(viewer, "leaving", "Stay" if leaving is not None and leaving.film else "Cancel")


def _ask(viewer: Viewer, to: str) -> None:
    state = viewer.state
    if state.is_unsaved:
        count = int(state.marks.deleted.sum())
        edits = {f"{count:,} deleted": count > 0, "some transformed": bool(state.session.moves)}
        said = " and ".join(edit for edit, is_made in edits.items() if is_made) or "as once opened"
        imgui.text_wrapped(f"Gaussians: {said}. The scene is not saved so.")
    for other in viewer.unsaved():
        imgui.text_wrapped(f"Notes, names, bookmarks or keyframes of {other.path.name} are in no project.")
    imgui.text_unformatted(f"Save before {to}?")
    if state.is_unsaved and ui.button("Save", "The scene as a new file, without what was deleted"):
        saving.save_and_leave(viewer)
    verb = ui.next_button if state.is_unsaved else ui.button
    if verb("Save the project", "Everything in one small file; the scene stays as it is"):
        saving.save_project_and_leave(viewer)
    if ui.next_button("Discard"):
        saving.go_on(viewer)


def _wait_for_film(viewer: Viewer) -> None:
    work = viewer.recorder.current
    if work is None:
        saving.go_on(viewer)
        return
    imgui.text_unformatted("The window closes once this is written.")
    imgui.progress_bar(work[1], ImVec2(-1, 0), work[0])
    if imgui.button("Stop it, and close"):
        saving.end_at_once(viewer)
