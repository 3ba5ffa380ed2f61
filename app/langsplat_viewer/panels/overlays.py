"""The images of the scene behind the panels, and the overlays on them with their panels."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import moderngl
import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui, imgui_ctx

from langsplat_core.arrays import Array, length_text
from langsplat_core.config import ColourMap
from langsplat_core.display.displays import QUERY_COLOURS, STRENGTH, Drawing, mapped, painted
from langsplat_core.query.describe import LevelWords
from langsplat_core.scene import LEVELS, NO_ORIGIN, Camera
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera import overlays
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.camera.overlays import PlacedText, placed
from langsplat_viewer.commands import with_key
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.rendering.request import Split
from langsplat_viewer.session import Note, Point, Ruler
from langsplat_viewer.state import Hover, OpenScene
from langsplat_viewer.viewer import Viewer, needs_scene

TOOLS_EM = 5.2  # of the left edge that two columns of tools take
GRIP = 12.0  # width of what can be taken hold of, window units
WHITE, SHADE, SHADE_EM = 0xFFFFFFFF, 0xA0000000, 0.2  # margin of a shade around its text
UNMOVED = ui.OVER | ui.FIXED | imgui.WindowFlags_.no_background | imgui.WindowFlags_.no_nav


def draw_pictures(viewer: Viewer, area: ui.Area, textures: tuple[moderngl.Texture, ...]) -> None:
    """Draw the textures of `Canvas.textures` where they belong, each with its name if there are several."""
    split, names = viewer.state.session.split, [pane.label for pane in viewer.state.panes()]
    if split.mode == "scenes":
        there = None if viewer.beside is None else viewer.beside.state.path
        names = ["" if path is None else path.name for path in (viewer.state.path, there)]
    parts, paint = parts_of(area, split), imgui.get_background_draw_list()
    for place, (part, texture) in enumerate(
        zip(parts if len(textures) > 1 else [area], textures, strict=False)
    ):
        whole = area if split.has_line else part  # of which the texture is
        start = (part.left - whole.left) / whole.width
        stop = start + part.width / whole.width
        ends = ImVec2(start, 1), ImVec2(stop, 0)  # GL's first row is the lowest
        paint.add_image(imgui.ImTextureRef(texture.glo), *part.corners, *ends)
        if place:
            paint.add_line(part.corners[0], ImVec2(part.left, area.top + area.height), SHADE, 4.0)
            paint.add_line(part.corners[0], ImVec2(part.left, area.top + area.height), WHITE, 1.5)
    gap = hello_imgui.em_size(0.6)
    for place, (part, name) in enumerate(zip(parts, names, strict=False) if len(parts) > 1 else ()):
        is_left = split.has_line and not place  # and ends at the line
        x = part.left + (part.width - gap - ui.width_of(name) if is_left else gap)
        x = max(x, area.left + hello_imgui.em_size(TOOLS_EM))
        text_on_shade(name, x, below_search(replace(area, left=x)).top + gap, area)


def below_search(part: ui.Area) -> ui.Area:
    """Return the part of an area below the search, open or folded; all of an area beside the search."""
    for _, card in ui.floating_windows("Search", "Folded search"):
        if card.x >= part.left:
            return replace(part, top=card.y, height=max(part.top + part.height - card.y, 1.0))
    return part


def parts_of(area: ui.Area, split: Split) -> list[ui.Area]:
    """Return the parts of the area that its images take, from left to right."""
    if not split.has_line:
        return area.columns(split.columns)
    at = split.at * area.width
    return [replace(area, width=at), replace(area, left=area.left + at, width=area.width - at)]


def text_on_shade(text: str, x: float, y: float, area: ui.Area) -> None:
    """Write text on a shade, nowhere outside the area."""
    paint, corner = imgui.get_background_draw_list(), ImVec2(x, y)
    edge = hello_imgui.em_to_vec2(SHADE_EM, SHADE_EM)
    paint.push_clip_rect(*area.corners)
    paint.add_rect_filled(corner - edge, corner + imgui.calc_text_size(text) + edge, SHADE, 3.0)
    paint.add_text(corner, WHITE, text)
    paint.pop_clip_rect()


def draw_grip(viewer: Viewer, area: ui.Area) -> None:
    """Draw the grip of the line of a wipe; a double click puts it into the middle."""
    split = viewer.state.session.split
    if not split.has_line or viewer.state.open is None:
        return
    x = area.left + split.at * area.width
    imgui.set_next_window_pos(ImVec2(x - GRIP / 2, area.top))
    imgui.set_next_window_size(ImVec2(GRIP, area.height))
    with theme.styled(window_padding=ImVec2(0, 0), window_min_size=ImVec2(1, 1)):
        imgui.begin("split", None, UNMOVED)
    imgui.invisible_button("line", ImVec2(GRIP, area.height))
    if imgui.is_item_hovered() or imgui.is_item_active():
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew)
        middle, paint = ImVec2(x, area.top + area.height / 2), imgui.get_foreground_draw_list()
        paint.add_circle_filled(middle, 0.5 * GRIP, WHITE)
        paint.add_circle(middle, 0.5 * GRIP, SHADE, 0, 2.0)
    if imgui.is_item_hovered() and imgui.is_mouse_double_clicked(0):
        settings.move_line(viewer, 0.5)
    elif imgui.is_item_active() and imgui.get_io().mouse_delta.x:
        settings.move_line(viewer, area.fraction(imgui.get_io().mouse_pos.x, 0)[0])
    imgui.end()


# Evidence of an answer.

EVIDENCE_EM = 50.0, 34.0  # size of the window at first


def draw_evidence(viewer: Viewer, picture: ui.Picture) -> None:
    """Draw the sheet of photographs and masks that an answer stands on, in a window of its own."""
    sheet, area = viewer.state.evidence, ui.scene_area()
    if sheet is None:
        return
    phrase, image = sheet
    texture = picture.texture(image)
    imgui.set_next_window_pos(ImVec2(area.left, area.top), imgui.Cond_.appearing)
    imgui.set_next_window_size(ui.fitting(*EVIDENCE_EM), imgui.Cond_.appearing)
    with theme.styled(window_border_size=1.0):
        _, still_open = imgui.begin(f"Evidence: {phrase}###evidence", True)
    width = imgui.get_content_region_avail().x
    imgui.image(imgui.ImTextureRef(texture.glo), ImVec2(width, width * texture.height / texture.width))
    imgui.end()
    if not still_open:
        settings.put(viewer.state, evidence=None)


# Overlays on every image: training cameras, boxes of instances, ground grid, ruler and notes.

Colour = tuple[float, float, float, float]
REACH = 7.0  # window units around a line in which a click hits it
STILL = 4.0  # a click that moves farther is a drag
CAMERA, CHOSEN, HOVERED = (0.75, 0.82, 0.95, 0.3), (0.98, 0.62, 0.15, 1.0), (1.0, 1.0, 1.0, 1.0)
AXES_EM = 5.0  # of the corner that the axes take
AXES = (("x", (0.93, 0.33, 0.31)), ("y", (0.45, 0.78, 0.30)), ("z", (0.36, 0.60, 0.98)))  # the world's
NOTE, GRID, RULER = (0.55, 0.85, 1.0, 1.0), (0.85, 0.85, 0.85, 0.4), (1.0, 0.9, 0.2, 1.0)


@dataclass(frozen=True)
class Named:
    """A thing that has a name in the image."""

    text: str
    corner: Array  # (2,) the highest one of its box, window units
    colour: Colour


@dataclass(frozen=True, eq=False)
class Pen:
    """Draws things of the world over one image of it; places are in window units."""

    area: ui.Area  # of the image
    camera: Camera
    least: float  # camera z from which on lines are drawn

    @property
    def corner(self) -> Array:
        return np.array([self.area.left, self.area.top])

    def segments(self, edges: Array) -> tuple[Array, Array]:
        """Return the visible parts (K, 2, 2) of (M, 2, 3) edges, and the rows that they come from."""
        found, rows = overlays.clip_segments(self.camera, edges, self.least)
        return found + self.corner, rows

    def place(self, point: Array | Point) -> Array | None:
        """Return (2,) where a world point is; None outside the image."""
        pixels, depths = self.camera.project(np.asarray(point, np.float64)[None])
        inside = depths[0] > self.least and self.camera.in_image(pixels, depths)[0]
        return pixels[0] + self.corner if inside else None


@needs_scene()
def draw_lines(viewer: Viewer, seen: OpenScene, area: ui.Area) -> None:
    """Draw grid, cameras, boxes, ruler and notes over every image in the area, after they are drawn."""
    state, shown = viewer.state, viewer.state.session.overlays
    view, radius, metres = seen.view, seen.extent.radius, seen.scene.metres_per_unit
    place, paint = (seen.extent, view.up, metres, seen.scene.origin), imgui.get_background_draw_list()
    grid = overlays.ground_grid(*place) if "grid" in shown else None
    for part in area.columns(state.session.split.columns):
        pen = Pen(part, view.camera(*part.size), overlays.LEAST_DEPTH * radius)
        paint.push_clip_rect(*part.corners, True)
        if grid is not None:
            _lines(pen.segments(grid[0])[0], GRID, 1.0)
        if "cameras" in shown:
            _cameras(viewer, seen.scene.cameras, overlays.FRUSTUM_DEPTH * radius, pen)
        if "things" in shown:  # after the lines, so that its words are readable
            _things(viewer, pen)
        _ruler(state.session.ruler, pen, metres)
        _notes(state.session.notes, pen)
        paint.pop_clip_rect()
    if "cube" in shown:  # as files call them
        _axes(view, area)
    foot = [] if grid is None else [f"grid {overlays.measured(grid[1], metres)}"]
    if view.orthographic:
        span = overlays.measured(view.span_in(*state.size), metres)
        foot.append(f"orthographic, {span} across the shorter side")
    left, y = area.left + hello_imgui.em_size(TOOLS_EM), area.top + area.height
    for text in foot:
        y -= 1.6 * imgui.get_text_line_height()
        text_on_shade(text, left, y, area)
    if not imgui.get_io().want_capture_mouse:
        _take_click(viewer, area)


def _take_click(viewer: Viewer, area: ui.Area) -> None:
    """Set a point of the ruler, or pin a note, where the scene is clicked for that."""
    cursors, measures = imgui.MouseCursor_, viewer.state.session.ruler.measures
    if not (measures or viewer.state.pins_notes):
        return
    imgui.set_mouse_cursor(cursors.resize_all if measures else cursors.hand)
    if clicked(area):
        mouse, act = imgui.get_io().mouse_pos, settings.measure_at if measures else settings.pin_at
        act(viewer, *area.fraction(mouse.x, mouse.y))


def clicked(area: ui.Area, button: int = 0) -> bool:
    """Return whether a button was clicked in the area, without modifiers and without a drag."""
    io = imgui.get_io()
    if io.want_capture_mouse or io.key_ctrl or io.key_shift or not imgui.is_mouse_released(button):
        return False
    moved = imgui.get_mouse_drag_delta(button, 0.0)
    u, v = area.fraction(io.mouse_pos.x, io.mouse_pos.y)
    return abs(moved.x) + abs(moved.y) < STILL and 0 <= u <= 1 and 0 <= v <= 1


def _lines(segments: Array, colour: Colour, thick: float) -> None:
    paint, packed = imgui.get_background_draw_list(), imgui.get_color_u32(colour)
    for start, end in segments.tolist():
        paint.add_line(ImVec2(*start), ImVec2(*end), packed, thick)


def _dot(place: Array, colour: Colour) -> None:
    paint, middle = imgui.get_background_draw_list(), ImVec2(*place)
    paint.add_circle_filled(middle, 4.0, imgui.get_color_u32(colour))
    paint.add_circle(middle, 5.0, SHADE)


def _cameras(viewer: Viewer, cameras: tuple[Camera, ...], depth: float, pen: Pen) -> None:
    """Draw cameras, `depth` deep, but the one that the view looks through; a click stands there."""
    state, mouse, edges = viewer.state, imgui.get_io().mouse_pos, overlays.frusta(cameras, depth)
    away = np.linalg.norm(edges[:, 0, 0] - pen.camera.position, axis=1) > pen.least
    edges = edges * away[:, None, None, None]  # all in one point, which is no line
    segments, rows = pen.segments(edges.reshape(-1, 2, 3))
    owners = rows // edges.shape[1]
    segments, owners = segments[away[owners]], owners[away[owners]]
    under = -1
    if not (imgui.get_io().want_capture_mouse or state.session.ruler.measures):
        row, distance = overlays.nearest_segment(segments, (mouse.x, mouse.y))
        under = int(owners[row]) if distance < REACH else -1
    chosen = -1 if state.camera_index is None else state.camera_index
    _lines(segments[(owners != under) & (owners != chosen)], CAMERA, 1.0)
    _lines(segments[owners == chosen], CHOSEN, 2.0)
    if under >= 0:
        _lines(segments[owners == under], HOVERED, 2.0)
        text_on_shade(f"camera {under}  {cameras[under].name}", mouse.x + 14, mouse.y + 10, pen.area)
        if clicked(pen.area):
            viewpoint.go_to_camera(viewer, under)


def _things(viewer: Viewer, pen: Pen) -> None:
    """Draw a box around each thing that a query shown has found, and the phrase beside it."""
    named: list[Named] = []
    for query in viewer.state.shown():
        if query is None or query.slot is None:
            continue
        red, green, blue = QUERY_COLOURS[query.slot]
        things = viewer.state.answer(query).things
        for number, thing in enumerate(things, start=1):
            segments, _ = pen.segments(overlays.box_edges(thing.oriented.corners))
            _lines(segments, (0.0, 0.0, 0.0, 0.5), 3.0)
            _lines(segments, (red, green, blue, 1.0), 1.5)
            if len(segments):
                ends = segments.reshape(-1, 2)
                text = query.phrase if len(things) == 1 else f"{query.phrase} {number}"
                named.append(Named(text, ends[ends[:, 1].argmin()], (red, green, blue, 1.0)))
    _names(named, pen.area)


def _names(named: list[Named], area: ui.Area) -> None:
    """Write names above their corners, clear of floating windows, with a line to those that moved."""
    line, edge, wanted = imgui.get_text_line_height(), hello_imgui.em_size(SHADE_EM), []
    for name in named:
        (x, y), size = name.corner - (area.left, area.top), imgui.calc_text_size(name.text)
        wanted.append(PlacedText(x + 4 - edge, y - 1.4 * line - edge, size.x + 2 * edge, size.y + 2 * edge))
    taken = [
        PlacedText(low.x - area.left, low.y - area.top, high.x - low.x, high.y - low.y)
        for low, high in ui.lying_over("Search", "Folded search", "Tools", "legend", "left legend")
    ]
    found = placed(wanted, (area.width, area.height), taken)
    for name, alone, label in zip(named, wanted, found, strict=True):
        if abs(label.y - alone.y) > label.height / 2:
            end = ImVec2(area.left + label.x, area.top + label.y + label.height / 2)
            colour = imgui.get_color_u32(name.colour)
            imgui.get_background_draw_list().add_line(ImVec2(*name.corner), end, colour, 1.5)
    for name, label in zip(named, found, strict=True):
        text_on_shade(name.text, area.left + label.x + edge, area.top + label.y + edge, area)


def _axes(view: OrbitCamera, area: ui.Area) -> None:
    """Draw the world's axes in the upper right corner. ImGuizmo's cube takes y as up and names no side."""
    side = min(hello_imgui.em_size(AXES_EM), area.width, area.height)
    paint, middle = imgui.get_background_draw_list(), (area.corners[1].x - side / 2, area.top + side / 2)
    for (letter, colour), axis in zip(AXES, view.rotation.T, strict=True):
        way, half = axis[:2] / max(float(np.linalg.norm(axis[:2])), 1e-3), imgui.calc_text_size(letter) / 2
        end = np.array(middle) + 0.3 * side * axis[:2]
        paint.add_line(ImVec2(*middle), ImVec2(*end), _packed(colour), 2.0)
        beyond = end + 1.2 * half.y * way  # the middle of the letter, off its line
        paint.add_text(ImVec2(*beyond) - half, _packed(colour), letter)


def _ruler(ruler: Ruler, pen: Pen, metres: float | None) -> None:
    for place in map(pen.place, ruler.points):
        if place is not None:
            _dot(place, RULER)
    if ruler.length is not None:
        segments, _ = pen.segments(np.array([ruler.points]))
        _lines(segments, (0.0, 0.0, 0.0, 0.6), 4.0)
        _lines(segments, RULER, 2.0)
        for segment in segments:
            x, y = segment.mean(0) + 8
            text_on_shade(overlays.measured(ruler.length, metres), x, y, pen.area)


def _notes(notes: Sequence[Note], pen: Pen) -> None:
    places = [(note, pen.place(note.at)) for note in notes]
    named = [Named(note.text, place, NOTE) for note, place in places if place is not None]
    for name in named:
        _dot(name.corner, NOTE)
    _names(named, pen.area)


# Legends, and words in place of an image.

STEPS = 32  # of a colour bar
BAR_EM, BAR_HEIGHT_EM, LEAST_EM, AROUND_EM = 11.0, 0.8, 6.0, 2.4  # least: beside the search; around the bar


def draw_legends(viewer: Viewer, area: ui.Area, free: ui.Area) -> None:
    """Draw what the colours of each image mean in its lower right corner, or why a scene shows nothing.

    A legend that has no room there, because of the search, is drawn with that of the next image.
    """
    other = viewer.beside
    bars = list[Callable[[float], None]]()  # of this image, and of those before that had no room
    images = [(viewer, pane.row.drawing, "") for pane in viewer.state.panes()]
    if other is not None:
        sides = (viewer, ", left"), (other, ", right")
        images = [(side, side.state.panes()[0].row.drawing, name) for side, name in sides]
    parts = parts_of(area, viewer.state.session.split) if len(images) > 1 else [free]
    for place, ((side, drawing, name), part) in enumerate(zip(images, parts, strict=False)):
        if name and (said := side.state.nothing or _not_here(side, viewer.state.session.chosen)):
            say(said, below_search(part), f"side{name}")
        if not side.state.nothing and (side, drawing, name) not in images[place + 1 :]:  # nothing twice
            bars += _bars(side, drawing, name)
        at, is_last = beside_search(part, free, 3 * len(bars)), place + 1 == len(images)
        if bars and at is not None and (is_last or at is part):
            ems = min(BAR_EM, max(at.width / hello_imgui.em_size(1) - AROUND_EM, LEAST_EM))
            with legend("legend" if is_last else "left legend", at):
                for bar in bars:
                    bar(hello_imgui.em_size(ems))
            bars = []


def _not_here(side: Viewer, phrase: str) -> str:
    query = side.state.session.query(phrase)
    result = None if query is None else side.state.result(query)
    return f"'{phrase}': {result.said}" if result is not None and result.verdict == "not here" else ""


def beside_search(part: ui.Area, free: ui.Area, rows: int) -> ui.Area | None:
    """Return where an image's legend of so many rows can be: all of it, beside the search, or nowhere."""
    em = hello_imgui.em_size(1)
    is_free = part.left >= free.left or below_search(part).height > (AROUND_EM + rows) * em
    places = (part, free) if is_free else (free,)
    return next((place for place in places if place.width > (LEAST_EM + AROUND_EM) * em - 1), None)


def _bars(viewer: Viewer, drawing: Drawing, of: str) -> list[Callable[[float], None]]:
    """Return functions that draw a bar of a width: one for depth, or one for each query shown as heat."""
    state, picture, shown = viewer.state, viewer.state.session.picture, viewer.state.shown_results()
    depths, answers = state.stats.depths, painted(shown) if drawing is Drawing.HEAT else {}
    if drawing is Drawing.DEPTH and depths is not None and state.open is not None:
        metres = state.open.scene.metres_per_unit
        scale, unit = (1.0, "units") if metres is None else (metres, "m")
        colours = bar_colours(1.0, picture.colour_map)[::-1]  # the nearest is the hottest
        return [partial(_bar, f"depth, {unit}{of}", colours, (scale * depths[0], scale * depths[1]), None)]
    bars: list[Callable[[float], None]] = []
    for slot, result in answers.items():
        colours = bar_colours(STRENGTH[result.verdict], picture.colour_map if len(answers) == 1 else slot)
        ends = picture.heat_scale or result.heat_range
        bars.append(partial(_bar, f"{result.phrase}{of}", colours, ends, result.cut))
    return bars


def legend(name: str, area: ui.Area) -> AbstractContextManager[None]:
    """Have what follows drawn in the lower right corner of the scene's area."""
    corner = area.corners[1] - hello_imgui.em_to_vec2(0.7, 0.7)
    return ui.floating(name, corner, ImVec2(1, 1), ui.QUIET)


def say(text: str, area: ui.Area, name: str = "said over the scene", top: float | None = None) -> None:
    """Write a line over the scene, in the middle of its area or `top` window units below its upper edge."""
    x, y = area.left + area.width / 2, area.top + (area.height / 2 if top is None else top)
    widest = 0.9 if top is None else 0.95  # of the area's width
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(widest * area.width, area.height))
    with (
        ui.floating(name, ImVec2(x, y), ImVec2(0.5, 0.5 if top is None else 0), ui.QUIET),
        imgui_ctx.push_text_wrap_pos((widest - 0.05) * area.width),
    ):
        imgui.text_unformatted(text)


def bar_colours(strength: float, by: ColourMap | int) -> Array:
    """Return the (STEPS, 3) colours of a bar from its coldest to its hottest end, as the image has them.

    by: the colour map, or the slot of a query among several, which has its own colour. A strength of one half
    ends in the middle of the colours.
    """
    heat = np.linspace(0, strength, STEPS)
    return (0.5 + 0.5 * heat)[:, None] * QUERY_COLOURS[by] if isinstance(by, int) else mapped(heat, by)


def _bar(text: str, colours: Array, ends: tuple[float, float], tick: float | None, width: float) -> None:
    """Draw a text, a bar with a tick at a value, and the values at its ends and in its middle."""
    height, (low, high) = hello_imgui.em_size(BAR_HEIGHT_EM), ends
    imgui.text_unformatted(ui.elided(text, width))
    start = imgui.get_cursor_screen_pos()
    draw_bar(start, width, height, colours)
    if tick is not None:
        x = start.x + width * min(max((tick - low) / (high - low), 0.0), 1.0)
        line = ImVec2(x, start.y - 2), ImVec2(x, start.y + height)
        for colour, thick in ((SHADE, 4.0), (WHITE, 2.0)):
            imgui.get_window_draw_list().add_line(*line, colour, thick)
    imgui.dummy(ImVec2(width, height))
    x, values = imgui.get_cursor_pos_x(), (low, (low + high) / 2, high)
    for place, text in zip((0.0, 0.5, 1.0), length_text(values, least=2).split(), strict=True):
        if place:
            imgui.same_line(x + place * (width - ui.width_of(text)))
        imgui.text_unformatted(text)


def draw_bar(start: Any, width: float, height: float, colours: Array) -> None:
    """Draw (STEPS, 3) colours from left to right, with the upper left corner at `start`."""
    paint = imgui.get_window_draw_list()
    for step, colour in enumerate(colours):
        left, right = (round(start.x + width * edge / STEPS) for edge in (step, step + 1))  # no seams
        paint.add_rect_filled(ImVec2(left, start.y), ImVec2(right, start.y + height), _packed(colour))


# The tooltip: what lies under the cursor.

UNSURE = 0.02  # a word less probable than this is not said


def draw_pointing(viewer: Viewer) -> None:
    """Draw the tooltip, where something was found under the mouse."""
    hover = viewer.state.hover
    if hover is None or hover.found is None or not imgui.begin_tooltip():
        return
    with imgui_ctx.push_text_wrap_pos(hello_imgui.em_size(24)):
        for name, words in zip(LEVELS, hover.found.words, strict=True):
            ui.coloured(name)
            imgui.same_line(hello_imgui.em_size(4.5))
            imgui.text_unformatted(said(words, viewer.has_percentages))
        for line in pointed_figures(hover, viewer.state.origin):
            ui.coloured(line)
    imgui.end_tooltip()


def said(words: LevelWords, sure: bool) -> str:
    """Return the most probable words of a place at one level; their percentages only where `sure`."""
    likely = [word for word in words.words if word.probability > UNSURE]
    named = [word.phrase + (f" {100 * word.probability:.0f} %" if sure else "") for word in likely]
    return ", ".join(named) if named else "nothing known"


def pointed_figures(hover: Hover, origin: Array = NO_ORIGIN) -> list[str]:
    """Return the relevancies of what is shown and the place in the world, a line each."""
    assert hover.found is not None
    lines = [
        f"{phrase}: {value:.2f}" for phrase, value in zip(hover.phrases, hover.found.relevancy, strict=True)
    ]
    place = length_text(hover.found.position, "  ", 2, origin)
    return [*lines, f"at {place}, {length_text(hover.found.depth, least=2)} away"]


def _packed(colour: Iterable[float]) -> int:
    red, green, blue = map(float, colour)
    return int(imgui.get_color_u32((red, green, blue, 1.0)))


# The panel "Notes".


def draw_notes(viewer: Viewer) -> None:
    """Draw the panel "Notes": texts pinned to places, kept in the project."""
    state, side = viewer.state, imgui.get_frame_height()
    pin = with_key("Pin one to what is clicked", settings.toggle_pinning)
    if imgui.checkbox(pin, state.pins_notes)[0]:
        settings.toggle_pinning(viewer)
    ui.verbs(viewer, "Save project")
    if not state.session.notes:
        ui.small_wrapped("notes are listed here")
    for number, note in enumerate(state.session.notes):
        with imgui_ctx.push_id(str(number)):
            imgui.set_next_item_width(-side - imgui.get_style().item_spacing.x)
            if note is state.fresh_note:
                imgui.set_keyboard_focus_here()
                settings.put(state, fresh_note=None)
            changed, text = imgui.input_text("##note", note.text)
            if changed and not imgui.is_key_pressed(imgui.Key.escape):  # which would take back what was typed
                settings.write_note(viewer, note, text)
            imgui.same_line()
            if ui.small("x", side):
                settings.take_off(viewer, "notes", note)
