"""Scenarios of `window_driver` about seeing: several pictures, what is drawn over them, measuring."""

from collections.abc import Callable
from itertools import combinations
from threading import Event, current_thread
from typing import Any

import numpy as np
from PIL import Image

from imgui_bundle import imgui  # isort: skip
from langsplat_viewer import canvas
from langsplat_viewer.actions import queries, selecting, settings, viewpoint
from langsplat_viewer.camera.overlays import Label, visible_faces
from langsplat_viewer.panels import overlays
from langsplat_viewer.panels.overlays import EDGE
from langsplat_viewer.panels.style import Area, scene_area
from langsplat_viewer.rendering.renderer import ArrayChannels
from tests.support.fakes import CENTRES

MUG, BOOK, PLANT = CENTRES


def begin(s: Any) -> None:
    s.wait(lambda: s.state.scene is not None)
    s.settle()


def split_the_view(s: Any) -> None:
    """The line is dragged without the camera; nothing is drawn for it, and nothing at rest."""
    begin(s)
    rgb = s.shot("rgb")
    s.ctx.key_press(imgui.Key.v)
    s.settle()
    assert s.state.settings.split.mode == "wipe"
    both, area, before = s.shot("both"), scene_area(), s.state.view
    np.testing.assert_allclose(s.at(both, MUG), s.at(rgb, MUG), atol=2)
    assert np.abs(s.at(both, PLANT) - s.at(rgb, PLANT)).max() > 40  # depth

    middle, y = area.left + area.width / 2, area.top + 0.8 * area.height
    drawn = s.renderer.count
    s.drag((middle, y), (area.left + 0.9 * area.width, y))
    s.settle()
    assert abs(s.state.settings.split.at - 0.9) < 0.02
    assert s.state.view is before
    assert s.renderer.count == drawn
    np.testing.assert_allclose(s.at(s.shot("wiped"), PLANT), s.at(rgb, PLANT), atol=2)

    s.drag((middle, y), (middle + 40, y))  # beside the line the camera turns as ever
    s.settle()
    assert s.state.view is not before
    s.menu("View", "Three levels side by side")
    s.settle()
    levels = s.shot("levels")
    assert s.renderer.count > drawn
    thirds = [levels[250:400, int(area.left + (i + 0.5) * area.width / 3)] for i in range(3)]
    assert np.abs(thirds[0] - thirds[2]).max() > 30
    drawn = s.renderer.count
    s.ctx.yield_(20)
    assert s.renderer.count == drawn


def on_screen(s: Any, point: np.ndarray) -> tuple[float, float]:
    """Where a world point is in the window."""
    area = scene_area()
    pixels, _ = s.state.view.camera(*s.state.size).project(point[None])
    return float(pixels[0, 0] + area.left), float(pixels[0, 1] + area.top)


def click(s: Any, place: tuple[float, float]) -> None:
    s.ctx.mouse_teleport_to_pos(place)
    s.ctx.yield_(2)
    s.ctx.mouse_click(0)
    s.ctx.yield_(2)


def draw_over_the_scene(s: Any) -> None:
    """The cube turns the view, a click on a camera stands there, two clicks measure."""
    begin(s)
    s.menu("View", "Show or hide the view cube")
    s.menu("View", "Show or hide the training cameras")
    s.settle()
    area = scene_area()
    before = s.state.view
    side = s.ctx.item_info("//view cube/cube").rect_full
    assert side.max.x <= area.left + area.width + 1
    name, place = next(face for face in faces_on_screen(s, side) if face[0] == "front")
    click(s, place)
    s.settle()
    assert s.state.view is not before
    assert [face[0] for face in faces_on_screen(s, side)] == [name]

    for _ in range(8):  # until all cameras are in the picture
        s.ctx.mouse_teleport_to_pos((area.left + area.width / 2, area.top + area.height / 2))
        s.ctx.mouse_wheel_y(-1)
        s.ctx.yield_(2)
    s.settle()
    camera = s.state.scene.cameras[2]
    seen = s.shot("cameras")
    s.menu("View", "Show or hide the training cameras")
    s.settle()
    assert np.abs(seen - s.shot("none"))[:, int(area.left) :].max() > 60
    s.menu("View", "Show or hide the training cameras")
    click(s, on_screen(s, camera.position))
    s.settle()
    assert s.state.camera_index == 2
    got = s.state.view.camera(160, 120).world_to_camera
    np.testing.assert_allclose(got, camera.world_to_camera, atol=1e-9)

    s.ctx.key_press(imgui.Key.m)
    s.ctx.yield_(2)
    turned = s.state.view
    for thing in (MUG, BOOK):
        click(s, on_screen(s, thing))
    assert s.state.view is turned
    assert abs(s.state.ruler.length - np.linalg.norm(MUG - BOOK)) < 0.2
    s.shot("ruler")
    drawn = s.renderer.count
    s.ctx.yield_(20)
    assert s.renderer.count == drawn
    s.ctx.key_press(imgui.Key.escape)
    s.ctx.yield_(2)
    assert not s.state.ruler.measures


def cut_by_depth(s: Any) -> None:
    """The sliders of the panel leave out what is nearer or farther; undone at their ends."""
    begin(s)
    settings.open_panel(s.window.viewer, "Camera")
    s.ctx.yield_(3)
    viewpoint.look_from(s.window.viewer, "left")
    s.settle()
    before = s.shot("whole")
    depths = [float((thing - s.state.view.eye) @ s.state.view.rotation[2]) for thing in CENTRES]
    s.ctx.item_input_value("//Camera/Near cut", max(min(depths), 0.1) + 0.6)
    s.settle()
    assert s.state.settings.clip.near > 0.5
    cut = s.shot("cut")
    assert np.abs(cut - before)[100:, 400:].max() > 60
    s.ctx.item_input_value("//Camera/Near cut", 0.0)
    s.settle()
    assert s.state.settings.clip.near == 0
    assert np.abs(s.shot("whole again") - before)[100:400, 400:].max() < 3


def time_and_compare(s: Any) -> None:
    """The panel tells medians while it is seen, and the error of what is shown."""
    begin(s)
    settings.open_panel(s.window.viewer, "Timing")
    s.ctx.yield_(3)
    for key in (imgui.Key["_2"], imgui.Key["_1"]):
        s.ctx.key_press(key)
        s.settle()
    queries.ask(s.window.viewer, "mug")
    s.settle()
    told = dict(s.state.timing.medians())
    assert {"Blend", "Picture, all of it", "Panels", "Search"} <= set(told)
    s.ctx.item_click("//Timing/Compare with the reference")
    s.wait(lambda: s.state.timing.comparison is not None)
    assert s.state.timing.comparison.psnr > 40
    s.shot("timing")
    count = len(s.state.timing.laps["panels"])
    assert count > 2
    s.menu("Window", "Timing")
    s.ctx.yield_(3)
    drawn = len(s.state.timing.laps["blend"])
    s.ctx.key_press(imgui.Key["_2"])
    s.settle()
    assert len(s.state.timing.laps["blend"]) == drawn


def faces_on_screen(s: Any, side: Any) -> list[tuple[str, tuple[float, float]]]:
    """Name and middle of each face of the cube that is seen, in the window."""
    middle, scale = (
        ((side.min.x + side.max.x) / 2, (side.min.y + side.max.y) / 2),
        EDGE * (side.max.x - side.min.x),
    )
    return [
        (face.name, (middle[0] + scale * face.centre[0], middle[1] + scale * face.centre[1]))
        for face in visible_faces(s.state.view)
    ]


def rasterize_elsewhere(s: Any) -> None:
    """While a thread rasterizes the fine picture the window shows a coarse one and works; what goes wrong
    there is said once."""
    gate, problems, rasterize = Event(), [], ArrayChannels.render

    def gated(self: ArrayChannels, *arguments: Any) -> Any:
        if current_thread().name == "langsplat-worker":
            assert gate.wait(60)
            if problems:
                raise problems[0]
        return rasterize(self, *arguments)

    ArrayChannels.render = gated
    canvas.MOVING_BUDGET = 0.0  # everything is slow
    begin(s)
    s.drag((600, 300), (656, 279))
    s.wait(lambda: s.window.viewer.surface.waits)
    assert s.state.stats.scale < 1
    s.ctx.key_press(imgui.Key.f1)
    s.ctx.yield_(3)
    assert s.state.show_help
    s.ctx.key_press(imgui.Key.f1)
    s.ctx.yield_(3)
    s.capture(s.folder / "coarse.png")
    gate.set()
    fine = s.shot("fine")
    assert s.state.stats.scale == 1
    coarse = np.asarray(Image.open(s.folder / "coarse.png").convert("RGB")).astype(int)
    for thing in CENTRES:
        np.testing.assert_allclose(s.at(coarse, thing), s.at(fine, thing), atol=25)

    problems.append(FloatingPointError("out of range"))
    s.drag((656, 279), (600, 300))
    s.settle()
    s.ctx.yield_(20)
    said = [message.text for message in s.state.messages if message.is_error]
    assert said == ["internal error: FloatingPointError: out of range"], said
    problems.clear()
    s.drag((600, 300), (656, 279))
    s.settle()
    assert s.state.stats.scale == 1


Scenario = tuple[Callable[[Any], None], str, dict[str, Any]]


def measure_and_select(s: Any) -> None:
    """From the mug to the book, then the book by a lasso."""
    s.ctx.key_press(imgui.Key.m)
    s.ctx.yield_(2)
    for thing in (MUG, BOOK):
        click(s, on_screen(s, thing))
    assert abs(s.state.ruler.length - np.linalg.norm(MUG - BOOK)) < 0.2
    s.ctx.key_press(imgui.Key.escape)
    s.ctx.yield_(2)

    selecting.use_tool(s.window.viewer, "lasso")
    middle = np.array(on_screen(s, BOOK))
    reach = 0.45 * (on_screen(s, PLANT)[0] - middle[0])
    turns = np.linspace(0, 2 * np.pi, 16)
    places = middle + reach * np.stack([np.cos(turns), np.sin(turns)], 1)
    s.ctx.mouse_teleport_to_pos(tuple(places[0]))
    s.ctx.mouse_down(0)
    for x, y in places:
        s.ctx.mouse_teleport_to_pos((x, y))
        s.ctx.yield_()
    s.ctx.mouse_up(0)
    s.ctx.yield_(2)
    selected = s.state.selection.marks.selected.reshape(3, -1).sum(1)
    assert selected[0] == selected[2] == 0
    assert selected[1] > 40
    s.shot("selected")
    selecting.use_tool(s.window.viewer, None)


def look_without_perspective(s: Any) -> None:
    """A key takes perspective away until it is pressed again; axes, wheel, tools and the click on a camera
    work as ever, and the picture says what it is."""
    begin(s)
    deep, view = s.shot("deep"), s.state.view
    s.ctx.key_press(imgui.Key.o)
    s.settle()
    assert s.state.view.back > 0
    flat, area = s.shot("flat"), scene_area()
    for thing in CENTRES:
        assert s.at(flat, thing).argmax() == s.at(deep, thing).argmax()
    corner = (slice(int(area.top + area.height) - 40, None), slice(int(area.left), int(area.left) + 200))
    assert (flat[corner].min(-1) > 200).sum() > 100  # words
    assert (deep[corner].min(-1) > 200).sum() == 0

    s.ctx.key_press(imgui.Key.keypad1)
    s.settle()
    before = on_screen(s, PLANT)[0] - on_screen(s, MUG)[0]
    s.ctx.mouse_teleport_to_pos((area.left + area.width / 2, area.top + area.height / 2))
    s.ctx.mouse_wheel_y(-1)
    s.ctx.yield_(2)
    s.settle()
    assert abs((on_screen(s, PLANT)[0] - on_screen(s, MUG)[0]) / before - 0.88) < 1e-3

    measure_and_select(s)
    s.menu("View", "Show or hide the training cameras")
    s.ctx.key_press(imgui.Key.home)
    s.settle()
    assert s.state.view.back > 0
    settings.open_panel(s.window.viewer, "Camera")
    s.ctx.yield_(4)
    s.ctx.item_click("//Camera/###orthographic")
    s.settle()
    np.testing.assert_allclose(
        s.state.view.camera(160, 120).world_to_camera, view.camera(160, 120).world_to_camera, atol=1e-9
    )
    s.ctx.key_press(imgui.Key.keypad5)
    s.ctx.yield_(2)
    assert s.state.view.back > 0
    viewpoint.zoom_by(s.window.viewer, 4.0)  # until all cameras are in the picture
    s.settle()
    s.shot("cameras")
    click(s, on_screen(s, s.state.scene.cameras[2].position))
    s.settle()
    assert (s.state.camera_index, s.state.view.back) == (2, 0.0)


def name_what_is_close(s: Any) -> None:
    """Things in one line of sight have their names one above the other."""
    begin(s)
    settings.show_overlay(s.window.viewer, "things", True)
    for word in ("mug", "book", "plant"):
        s.search(word)
    viewpoint.look_from(s.window.viewer, "left")
    s.settle()
    written, write = [], overlays.text_on_shade

    def remembered(text: str, x: float, y: float, area: Area) -> None:
        size = imgui.calc_text_size(text)
        written.append((text, Label(x, y, size.x, size.y)))
        write(text, x, y, area)

    overlays.text_on_shade = remembered
    s.ctx.yield_(2)
    overlays.text_on_shade = write
    frame = dict(written)
    assert set(frame) == {"mug", "book", "plant"}
    assert not any(a.covers(b) for a, b in combinations(frame.values(), 2))
    assert written[:3] == written[3:6]  # from frame to frame the same
    s.shot("names")


SCENARIOS: dict[str, Scenario] = {
    "name_what_is_close": (name_what_is_close, "blobs.ply", {}),
    "look_without_perspective": (look_without_perspective, "blobs.ply", {}),
    "split_the_view": (split_the_view, "blobs.ply", {}),
    "cut_by_depth": (cut_by_depth, "blobs.ply", {}),
    "time_and_compare": (time_and_compare, "blobs.ply", {}),
    "rasterize_elsewhere": (rasterize_elsewhere, "blobs.ply", {"backend": "cpu"}),
    "draw_over_the_scene": (draw_over_the_scene, "blobs.ply", {}),
}
