"""The pictures of the scene behind the panels, and the line between two of them."""

from typing import Any

import moderngl
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.panels.area import Area
from langsplat_viewer.viewer import Viewer

GRIP = 12.0  # width of what can be taken hold of, window units
WHITE, SHADE = 0xFFFFFFFF, 0xA0000000
UNMOVED = (
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_background
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_bring_to_front_on_focus
    | imgui.WindowFlags_.no_nav
    | imgui.WindowFlags_.no_move
    | imgui.WindowFlags_.no_docking
)


def draw(viewer: Viewer, area: Area, textures: tuple[moderngl.Texture, ...]) -> None:
    """The textures of `Canvas.textures` where they belong, each with its name if there are several."""
    split = viewer.state.settings.split
    if split.mode == "wipe" and len(textures) > 1:
        _image(area, textures[0], 0.0, split.at)
        _image(area, textures[1], split.at, 1.0)
        _line(area, split.at)
    elif split.mode == "levels" and len(textures) > 1:
        width = area.width / len(textures)
        for place, texture in enumerate(textures):
            _image(Area(area.left + place * width, area.top, width, area.height), texture, 0.0, 1.0)
        for place in range(1, len(textures)):
            _line(area, place / len(textures))
    elif textures:
        _image(area, textures[0], 0.0, 1.0)
    _name(viewer, area)


def _image(area: Area, texture: moderngl.Texture, start: float, stop: float) -> None:
    """The part of a texture between two fractions of its width, at its place in `area`."""
    imgui.get_background_draw_list().add_image(
        imgui.ImTextureRef(texture.glo),
        ImVec2(area.left + start * area.width, area.top),
        ImVec2(area.left + stop * area.width, area.top + area.height),
        ImVec2(start, 1),  # GL's first row is the lowest
        ImVec2(stop, 0),
    )


def _line(area: Area, at: float) -> None:
    x, paint = area.left + at * area.width, imgui.get_background_draw_list()
    ends = ImVec2(x, area.top), ImVec2(x, area.top + area.height)
    paint.add_line(*ends, SHADE, 4.0)
    paint.add_line(*ends, WHITE, 1.5)


def _name(viewer: Viewer, area: Area) -> None:
    """What each picture shows, at its upper edge: left and right of the line of a wipe."""
    split, names = viewer.state.settings.split, tuple(pane.label for pane in viewer.state.panes())
    gap, top = hello_imgui.em_size(0.6), area.top + hello_imgui.em_size(0.5)
    if split.mode == "wipe":
        x = area.left + split.at * area.width
        text_on_shade(names[0], x - gap - imgui.calc_text_size(names[0]).x, top, area)
        text_on_shade(names[1], x + gap, top, area)
    elif split.mode == "levels":
        for place, name in enumerate(names):
            text_on_shade(name, area.left + place * area.width / len(names) + gap, top, area)


def shade_edge() -> float:
    """How far the shade of `text_on_shade` reaches beyond the text, window units."""
    return float(hello_imgui.em_size(0.2))


def text_on_shade(text: str, x: float, y: float, area: Area) -> None:
    """On a shade, nowhere outside the area."""
    paint, size, edge = imgui.get_background_draw_list(), imgui.calc_text_size(text), shade_edge()
    paint.push_clip_rect(ImVec2(area.left, area.top), ImVec2(area.left + area.width, area.top + area.height))
    paint.add_rect_filled(
        ImVec2(x - edge, y - edge), ImVec2(x + size.x + edge, y + size.y + edge), SHADE, 3.0
    )
    paint.add_text(ImVec2(x, y), WHITE, text)
    paint.pop_clip_rect()


def draw_grip(viewer: Viewer, area: Area) -> None:
    """What the line of a wipe is dragged by; a double click puts it into the middle."""
    split = viewer.state.settings.split
    if split.mode != "wipe" or viewer.state.scene is None:
        return
    x = area.left + split.at * area.width
    imgui.push_style_var(imgui.StyleVar_.window_padding, ImVec2(0, 0))
    imgui.push_style_var(imgui.StyleVar_.window_min_size, ImVec2(1, 1))
    imgui.set_next_window_pos(ImVec2(x - GRIP / 2, area.top))
    imgui.set_next_window_size(ImVec2(GRIP, area.height))
    imgui.begin("split", None, UNMOVED)
    imgui.invisible_button("line", ImVec2(GRIP, area.height))
    if imgui.is_item_hovered() or imgui.is_item_active():
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew)
        _knob(x, area)
    if imgui.is_item_hovered() and imgui.is_mouse_double_clicked(0):
        actions.move_line(viewer, 0.5)
    elif imgui.is_item_active() and imgui.get_io().mouse_delta.x:
        actions.move_line(viewer, area.fraction(imgui.get_io().mouse_pos.x, 0)[0])
    imgui.end()
    imgui.pop_style_var(2)


def _knob(x: float, area: Area) -> None:
    middle, paint = ImVec2(x, area.top + area.height / 2), _foreground()
    paint.add_circle_filled(middle, 0.5 * GRIP, WHITE)
    paint.add_circle(middle, 0.5 * GRIP, SHADE, 0, 2.0)


def _foreground() -> Any:
    return imgui.get_foreground_draw_list()
