"""Panel "Library": the scenes of a folder with thumbnails, ranked by a phrase."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.arrays import Array
from langsplat_core.extensions.library.index import THUMBNAIL, Answers, Hit, Library, find, update_library
from langsplat_core.progress import Progress
from langsplat_core.query.engine import LoadEncoder
from langsplat_core.query.rule import Verdict
from langsplat_viewer.actions.opening import open_scene
from langsplat_viewer.actions.queries import ask
from langsplat_viewer.actions.settings import ask_for, open_panel
from langsplat_viewer.panels import ui
from langsplat_viewer.panels.layout import Panel
from langsplat_viewer.state import FileChoice
from langsplat_viewer.viewer import Viewer

TITLE = "Library"
MOST_HITS = 200  # scenes that the panel lists
THUMBNAIL_EM = 3.6  # height of a thumbnail


@dataclass(frozen=True, eq=False)
class LibraryView:
    """State of the panel."""

    library: Library
    load_encoder: LoadEncoder  # caches the last encoder
    phrase: str = ""  # that scenes are ranked by; "": by name
    hits: tuple[Hit, ...] = ()  # the first `MOST_HITS` scenes
    said: str = ""  # summary of the answers
    thumbnails: Array | None = None  # (H, W, 3) uint8 of the listed hits, one below the other
    typed: str = ""


UNASKED = Verdict(False, "chance", -math.inf)


def library_view(viewer: Viewer) -> LibraryView | None:
    """Return the state of the panel; None before a folder was chosen."""
    return viewer.state.extension_panels.get(TITLE)


def open_library(viewer: Viewer, folder: Path) -> None:
    """Update the library of a folder in the background, and show it."""
    load = lru_cache(maxsize=1)(viewer.services.load_encoder)

    def done(library: Library) -> None:
        hits = [Hit(folder / scene.path, UNASKED) for scene in library.scenes]
        _show_hits(viewer, LibraryView(library, load, said=f"{len(hits)} scenes"), hits)
        for scene in library.unread:
            viewer.say_error(f"{scene.path}: {scene.unread}")
        open_panel(viewer, TITLE)

    def work(progress: Progress) -> Library:
        return update_library(folder, load_encoder=load, progress=progress)

    viewer.run(f"reading the scenes of {folder.name}", work, done)


def ask_library(viewer: Viewer, phrase: str) -> None:
    """Rank the scenes of the library by a phrase, in the background."""
    view = library_view(viewer)
    if view is None or not phrase.strip():
        return
    library, phrase = view.library, phrase.strip()

    def done(answers: list[Answers]) -> None:
        hits = sorted((hit for each in answers for hit in each.hits), key=lambda hit: -hit.margin)
        found = sum(hit.verdict == "found" for hit in hits)
        problems = [each.problem for each in answers if each.problem]
        said = "; ".join([f"'{phrase}': found in {found} of {len(hits)} scenes", *problems])
        _show_hits(viewer, replace(view, phrase=phrase, said=said), hits)

    def work(progress: Progress) -> list[Answers]:
        return find(library, phrase, view.load_encoder, 0, progress)

    viewer.run(f"searching '{phrase}' in {len(library.scenes)} scenes", work, done)


def _show_hits(viewer: Viewer, view: LibraryView, hits: Sequence[Hit]) -> None:
    listed = tuple(hits[:MOST_HITS])
    names = [hit.path.relative_to(view.library.folder).as_posix() for hit in listed]
    image = np.concatenate([view.library.thumbnails[name] for name in names]) if names else None
    viewer.state.extension_panels[TITLE] = replace(view, hits=listed, thumbnails=image)


_thumbnails = ui.Picture()  # of the whole list


def draw_library(viewer: Viewer) -> None:
    """Draw the folder, the box for a phrase and the list."""
    view = library_view(viewer)
    if ui.button(
        "Folder ...", "Search all scenes of a folder and the folders in it. An index of them is kept there"
    ):
        ask_for(viewer, FileChoice("Folder of scenes", open_library, "folder"))
    if view is None:
        return
    imgui.same_line()
    imgui.align_text_to_frame_padding()
    name = str(view.library.folder)
    ui.coloured(ui.elided(name, imgui.get_content_region_avail().x))
    ui.tip(name)
    hint = "what to look for in all of them"
    entered, typed = ui.box("##library", hint, view.typed)
    viewer.state.extension_panels[TITLE] = view = replace(view, typed=typed)
    if entered:
        ask_library(viewer, typed)
    ui.small_wrapped(view.said)
    if ui.begin_list("library"):
        for row, hit in enumerate(view.hits):
            imgui.push_id(row)
            _hit(viewer, view, row, hit)
            imgui.pop_id()
    imgui.end_child()


def _hit(viewer: Viewer, view: LibraryView, row: int, hit: Hit) -> None:
    """Show a thumbnail, the scene's name and its verdict; a click anywhere opens the scene."""
    height = hello_imgui.em_size(THUMBNAIL_EM)
    width, count = height * THUMBNAIL[0] / THUMBNAIL[1], len(view.hits)
    start = imgui.get_cursor_pos()
    if imgui.selectable("##scene", hit.path == viewer.state.path, size=ImVec2(0, height))[0]:
        open_scene(viewer, hit.path, lambda viewer: ask(viewer, view.phrase))
    ui.tip(str(hit.path))
    imgui.set_cursor_pos(start)
    if view.thumbnails is not None and view.thumbnails.size:
        texture = _thumbnails.texture(view.thumbnails)
        ends = ImVec2(0, row / count), ImVec2(1, (row + 1) / count)
        imgui.image(imgui.ImTextureRef(texture.glo), ImVec2(width, height), *ends)
    imgui.same_line()
    imgui.begin_group()
    room = imgui.get_content_region_avail().x
    imgui.text(ui.elided(hit.path.relative_to(view.library.folder).as_posix(), room))
    if view.phrase:
        ui.coloured(hit.said, "good" if hit.verdict == "found" else "soft")
    imgui.end_group()


PANEL = Panel(TITLE, draw_library)
