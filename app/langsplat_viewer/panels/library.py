"""The panel "Library": the scenes of a folder with thumbnails, ranked by a phrase."""

import moderngl
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.query.finding import Hit
from langsplat_core.query.library import THUMBNAIL
from langsplat_viewer.actions import opening
from langsplat_viewer.panels.style import elided, good, muted, small_wrapped, tip, width_of
from langsplat_viewer.state import LibraryView
from langsplat_viewer.viewer import Viewer

HEIGHT_EM = 3.6  # of a thumbnail


class _Atlas:
    """The thumbnails of the list, as one texture."""

    def __init__(self) -> None:
        self._of: LibraryView | None = None
        self._texture: moderngl.Texture | None = None

    def texture(self, view: LibraryView) -> moderngl.Texture | None:
        """Return the texture of the list's thumbnails; None for a list without scenes."""
        if self._of is not view:
            if self._texture is not None:
                self._texture.release()
            self._of, self._texture, image = view, None, view.thumbnails
            if image is not None and image.size:
                size = image.shape[1], image.shape[0]
                ctx = moderngl.get_context()
                self._texture = ctx.texture(size, 3, image.tobytes(), alignment=1)
        return self._texture


_atlas = _Atlas()


def draw(viewer: Viewer) -> None:
    """Draw the folder, the box for a phrase and the list."""
    view = viewer.state.library
    if imgui.button("Folder ..."):
        opening.ask_for_folder(viewer, "library")
    tip("Search all scenes of a folder and the folders in it. An index of them is kept there")
    if view is None:
        return
    imgui.same_line()
    imgui.align_text_to_frame_padding()
    name = str(view.library.folder)
    imgui.text_colored(muted(), elided(name, imgui.get_content_region_avail().x, width_of))
    tip(name)
    imgui.set_next_item_width(-1)
    flags = imgui.InputTextFlags_.enter_returns_true
    hint = "what to look for in all of them"
    entered, typed = imgui.input_text_with_hint("##library", hint, viewer.state.library_typed, flags)
    opening.type_library(viewer, typed)
    if entered:
        opening.ask_library(viewer, typed)
    small_wrapped(view.said, muted())
    if imgui.begin_child("library"):
        for row, hit in enumerate(view.hits):
            imgui.push_id(row)
            _row(viewer, view, row, hit)
            imgui.pop_id()
    imgui.end_child()


def _row(viewer: Viewer, view: LibraryView, row: int, hit: Hit) -> None:
    """A thumbnail, the scene's name and its verdict; a click anywhere opens the scene."""
    texture, height = _atlas.texture(view), hello_imgui.em_size(HEIGHT_EM)
    width, count = height * THUMBNAIL[0] / THUMBNAIL[1], len(view.hits)
    start = imgui.get_cursor_pos()
    if imgui.selectable("##scene", hit.path == viewer.state.path, size=ImVec2(0, height))[0]:
        opening.open_hit(viewer, hit)
    tip(str(hit.path))
    imgui.set_cursor_pos(start)
    if texture is not None:
        ends = ImVec2(0, row / count), ImVec2(1, (row + 1) / count)
        imgui.image(imgui.ImTextureRef(texture.glo), ImVec2(width, height), *ends)
    imgui.same_line()
    imgui.begin_group()
    room = imgui.get_content_region_avail().x
    imgui.text(elided(hit.path.relative_to(view.library.folder).as_posix(), room, width_of))
    if view.phrase:
        sure = "" if hit.probability is None else f" ({100 * hit.probability:.0f} %)"
        imgui.text_colored(good() if hit.verdict == "found" else muted(), hit.verdict + sure)
    imgui.end_group()
