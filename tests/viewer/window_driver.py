"""Drives the real window through imgui's test engine; run by test_window.py in a process of its own.

Its arguments: SCENARIO FOLDER. A scenario asserts as it goes and ends with "PASSED". FOLDER holds the scenes
and is the working folder.
"""

import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from imgui_bundle import ImVec2, hello_imgui, imgui  # isort: skip
from imgui_bundle.glfw_utils import glfw_window_hello_imgui  # isort: skip
import glfw  # isort: skip
from imgui_bundle.immapp import testing  # isort: skip
from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import QUERY_COLOURS
from langsplat_core.errors import BackendError
from langsplat_core.io.scenes import load_scene
from langsplat_core.scene import Scene
from langsplat_viewer.actions import selecting, settings
from langsplat_viewer.commands import COMMANDS, Command
from langsplat_viewer.files.preferences import with_recent
from langsplat_viewer.panels.layout import button_label
from langsplat_viewer.panels.ui import scene_area
from langsplat_viewer.rendering.renderer import Backend, GlRenderer
from langsplat_viewer.viewer import Services
from langsplat_viewer.window import Window, WindowRequest
from tests.support.fakes import CENTRES, FakeEncoder
from tests.support.processes import serve
from tests.viewer import scenarios_panels, scenarios_scene

MUG, BOOK, PLANT = CENTRES
PATIENCE = 240.0  # seconds: other tests may have the cores


def digit_key(digit: int) -> imgui.Key:
    return imgui.Key[f"_{digit}"]


class CountingRenderer(GlRenderer):
    """Counts the pictures it draws."""

    def __init__(self, ctx, backend: Backend) -> None:
        super().__init__(ctx, backend)
        self.count = 0

    def draw(self, request, targets) -> None:
        self.count += len(targets)
        super().draw(request, targets)


class Session:
    """A window under test."""

    patience = PATIENCE
    watched = False  # frames are drawn: not those that no picture is taken of

    def __init__(
        self,
        folder: Path,
        scene: str,
        load=load_scene,
        size=(860, 620),
        backend: Backend = "opengl",
        **request,
    ) -> None:
        self.folder, self.backend = folder, backend
        self.is_slow = load is not load_scene  # the scenario begins while the scene is read
        self.renderer: CountingRenderer | None = None
        services = Services(load, lambda encoder_id: FakeEncoder())
        self.window = Window(
            WindowRequest(folder / scene, size=size, **request), services, self._make_renderer
        )
        self.window.idles = False
        self.state = self.window.viewer.state

    def _make_renderer(self, ctx) -> CountingRenderer:
        self.renderer = CountingRenderer(ctx, self.backend)
        return self.renderer

    def run(self, test: Callable[["Session"], None]) -> None:
        def body(ctx) -> None:
            self.ctx = ctx
            engine = imgui.test_engine.get_io(hello_imgui.get_imgui_test_engine())
            engine.config_watchdog_warning = engine.config_watchdog_kill_test = self.patience
            if not self.is_slow:
                self.wait(lambda: self.state.scene is not None)
                self.settle()
            test(self)

        testing.run(test_function=body, runner_params=self.params())

    def params(self) -> hello_imgui.RunnerParams:
        """Of the window. A frame takes llvmpipe ten milliseconds of two cores: at next to no pixels per unit,
        imgui's backend leaves it out."""
        params = self.window.params()
        picture, kept = params.callbacks.before_imgui_render, ImVec2(1, 1)

        def scale(pixels: ImVec2) -> None:
            imgui.get_io().display_framebuffer_scale = pixels
            imgui.get_main_viewport().framebuffer_scale = pixels

        def unwatched() -> None:
            nonlocal kept
            picture()
            kept = ImVec2(imgui.get_io().display_framebuffer_scale)
            if not self.watched:
                scale(ImVec2(1e-6, 1e-6))

        params.callbacks.before_imgui_render = unwatched
        params.callbacks.after_swap = lambda: scale(kept)
        return params

    def wait(self, condition: Callable[[], bool]) -> None:
        end = time.monotonic() + self.patience / 2  # a thread that works may get little of the cores
        while time.monotonic() < end:
            self.ctx.yield_()
            if condition():
                return
        raise AssertionError("waited in vain")

    def settle(self) -> None:
        """Until nothing moves and nothing is under way."""
        self.ctx.yield_(2)
        self.wait(lambda: self.window.viewer.worker.current is None and self.state.glide is None)
        self.wait(lambda: not self.window.unfinished)
        self.ctx.yield_(2)

    def rest(self, frames: int) -> None:
        """Let so many frames pass, or, for 0, wait until it is settled."""
        if frames:
            self.ctx.yield_(frames)
        else:
            self.settle()

    def key(self, key: imgui.Key, frames: int = 0) -> None:
        """Press a key, then `rest`."""
        self.ctx.key_press(key)
        self.rest(frames)

    def click(self, item: str, frames: int = 0) -> None:
        """Click an item, then `rest`."""
        self.ctx.item_click(item)
        self.rest(frames)

    def type(self, text: str, frames: int) -> None:
        """Type characters, then let so many frames pass."""
        self.ctx.key_chars(text)
        self.ctx.yield_(frames)

    def enter(self, text: str, frames: int = 0) -> None:
        """Type characters and Enter, then `rest`."""
        self.ctx.key_chars_append_enter(text)
        self.rest(frames)

    def open_panel(self, title: str, frames: int = 0) -> None:
        """Open a panel, then `rest`."""
        settings.open_panel(self.window.viewer, title)
        self.rest(frames)

    def shot(self, name: str) -> np.ndarray:
        """(H, W, 3) the whole window."""
        self.settle()
        path = self.folder / f"{name}.png"
        self.capture(path)
        return np.asarray(Image.open(path).convert("RGB")).astype(int)

    def capture(self, path: Path) -> None:
        """The window as it is."""
        before, self.watched = self.watched, True
        self.ctx.yield_(2)
        testing.capture(self.ctx, str(path))
        self.watched = before

    def at(self, shot: np.ndarray, point: np.ndarray) -> np.ndarray:
        """(3,) mean colour of the 5 x 5 pixels around a world point."""
        width, height = self.state.size
        (x, y), _ = (part[0] for part in self.state.view.camera(width, height).project(point[None]))
        area = scene_area()
        column, row = int(x + area.left), int(y + area.top)
        return shot[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(0)

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 8) -> None:
        """With the left button, in window units; a frame for each step."""
        self.ctx.mouse_teleport_to_pos(start)
        self.ctx.mouse_down(0)
        for x, y in np.linspace(start, end, steps):
            self.ctx.mouse_teleport_to_pos((x, y))
            self.ctx.yield_()
        self.ctx.mouse_up(0)

    def menu(self, name: str, item: str) -> None:
        """Click an item of a menu."""
        self.ctx.item_click(f"//**/##MenuBar/{name}")
        self.ctx.item_click(f"//$FOCUSED/{item}")
        self.ctx.yield_(3)

    def search(self, phrase: str, stay: bool = False) -> None:
        self.ctx.item_click("//**/##phrase")
        self.ctx.key_chars_append_enter(phrase)
        self.settle()
        if not stay:  # in the box
            self.ctx.key_press(imgui.Key.escape)
            self.ctx.yield_(2)


def look_and_search(s: Session) -> None:
    rgb = s.shot("rgb")
    assert [s.at(rgb, thing).argmax() for thing in CENTRES] == [0, 1, 2]

    # A picture is drawn again only when something changed.
    drawn = s.renderer.count
    s.ctx.yield_(20)
    assert s.renderer.count == drawn

    find_the_plant(s, rgb)
    both = find_more(s)
    try_displays(s, both, panel=rgb[600, 5])
    use_keys(s)
    save_with_a_key(s)


def find_the_plant(s: Session, rgb: np.ndarray) -> None:
    # Typing owns the keyboard: the p of "plant" saves no picture, its a and t move nothing.
    before = s.state.view
    s.search("plant", stay=True)
    assert s.state.view is before
    assert list(s.folder.glob("blobs-*.png")) == []
    assert s.state.queries[0].result.found
    # The box keeps the keyboard, until Esc leaves it: then the next letter is a key again.
    assert imgui.get_io().want_text_input
    s.type("ff", frames=2)
    assert s.state.typed == "ff"
    assert s.state.view is before
    for _ in range(2):
        s.key(imgui.Key.escape, frames=2)
    s.key(imgui.Key.f)
    assert s.state.typed == ""
    np.testing.assert_allclose(s.state.view.target, s.state.queries[0].result.place)
    s.key(imgui.Key.r)
    heat = s.shot("heat")
    hot = s.at(heat, PLANT)
    assert hot[0] > hot[2] + 60  # blue turned hot
    np.testing.assert_allclose(s.at(heat, BOOK), 0.45 * s.at(rgb, BOOK), atol=6)  # the rest is dimmed

    # The heat stays on the thing while the camera moves round it.
    s.drag((600, 300), (656, 279))
    moved = s.shot("moved")
    assert s.state.view is not before
    # Blended relevancy depends on the view: the colour may be another hot one.
    warm = s.at(moved, PLANT)
    assert warm[0] > warm[2] + 60
    assert warm[2] < 60 < s.at(rgb, PLANT)[2]


def find_more(s: Session) -> np.ndarray:
    s.search("sofa")
    assert "sofa" in s.state.queries[1].problem
    s.search("mug")
    both = s.shot("both")
    # Each in its own colour.
    for point, slot in ((PLANT, 0), (MUG, 1)):  # what is unknown takes none
        tint = 255 * QUERY_COLOURS[slot]
        np.testing.assert_allclose(s.at(both, point), 0.85 * tint, atol=45)
    return both


def try_displays(s: Session, both: np.ndarray, panel: np.ndarray) -> None:
    """Every display is another picture; `panel` is a pixel of the panel, which none of them may colour."""
    seen = [both]
    for label in ("Colours", "Depth", "Alpha", "Segmentation", "subpart##latent", "whole##latent"):
        s.ctx.item_click(f"//**/{label}")
        shot = s.shot(label.replace("#", ""))
        assert all(np.abs(shot[:, 400:] - other[:, 400:]).max() > 30 for other in seen), label
        assert (shot[600, 5] == panel).all(), f"{label} coloured the panel"
        seen.append(shot)
    alpha = seen[3][100:500, 450:]  # right of the toolbar
    assert (alpha.max(-1) == alpha.min(-1)).all()
    assert alpha.max() > 200


def use_keys(s: Session) -> None:
    """Keys, away from the box."""
    s.ctx.mouse_teleport_to_pos((600, 550))
    s.ctx.mouse_click(0)
    for digit, display in enumerate(
        ("rgb", "depth", "alpha", "relevancy", "segmentation", "latent"), start=1
    ):
        s.key(digit_key(digit), frames=2)
        assert s.state.picture.display == display
    s.key(digit_key(7), frames=2)
    assert (s.state.picture.display, s.state.latent_level) == ("latent", 1)
    s.ctx.key_press(digit_key(1))
    s.key(imgui.Key.r)
    assert s.state.picture.display == "rgb"
    width = s.state.size[0]
    s.key(imgui.Key.f11)
    assert s.state.size[0] == 860
    assert width < 600
    s.key(imgui.Key.f11)
    s.key(imgui.Key.f)
    np.testing.assert_allclose(s.state.view.target, s.state.queries[-1].result.place)


def save_with_a_key(s: Session) -> None:
    s.key(imgui.Key.p, frames=2)
    saved = np.asarray(Image.open(s.folder / "blobs-001.png")).astype(int)
    assert saved.shape == (s.state.size[1], s.state.size[0], 3)
    shown = s.shot("saved")
    area = scene_area()
    shown = shown[int(area.top) : int(area.top) + 480, int(area.left) : int(area.left) + s.state.size[0]]
    clear = np.s_[:480, 100:]  # left of it the toolbar, below the cursor
    np.testing.assert_allclose(saved[clear], shown[clear], atol=3)
    assert not list(s.folder.glob("*.ini"))


def without_field(s: Session) -> None:
    assert any("langsplat train" in message.text for message in s.state.messages)
    assert not s.ctx.item_exists("//**/##phrase")
    s.ctx.key_press(digit_key(4))  # relevancy: refused with a line, not a crash
    assert s.state.picture.display == "rgb"

    s.window.drop([str(s.folder / "truncated.ply")])
    s.settle()
    assert s.state.messages[-1].is_error
    assert "truncated.ply" in s.state.messages[-1].text
    assert s.state.path.name == "plain.ply"

    s.window.drop([str(s.folder / "blobs.ply")])
    s.wait(lambda: s.state.path.name == "blobs.ply")
    s.settle()
    assert s.ctx.item_exists("//**/##phrase")
    s.open_panel("Scene", frames=3)
    s.ctx.item_click("//**/Help")
    s.open_panel("Camera", frames=3)
    s.ctx.item_click("//**/##next")
    s.wait(lambda: s.state.camera_index == 1)
    s.shot("help")


def from_the_command_line(s: Session) -> None:
    assert [query.phrase for query in s.state.queries] == ["mug", "sofa", "plant"]
    assert [query.result is not None for query in s.state.queries] == [True, False, True]
    assert s.state.picture.display == "segmentation"
    assert s.state.level == "whole"
    expected = s.state.scene.cameras[2]
    np.testing.assert_allclose(s.state.view.eye, expected.position, atol=1e-9)
    np.testing.assert_allclose(s.state.view.rotation, expected.rotation, atol=1e-9)
    assert s.state.view.orthographic
    assert abs(s.state.view.span - 4.0) < 1e-9


def broken_renderer(s: Session) -> None:
    """A driver that fails while drawing: the window lives on and says so once."""

    def fail(*args, **kwargs) -> None:
        raise BackendError("the driver gave up; use --backend cpu")

    s.renderer.draw = fail
    s.key(digit_key(2))
    s.ctx.yield_(20)
    assert s.state.messages[-1].text == "the driver gave up; use --backend cpu"
    del s.renderer.draw
    s.ctx.key_press(digit_key(3))
    assert s.shot("mended")[:, 400:].max() > 100


def close_while_opening(s: Session) -> None:
    """The window may be closed at any time; the process ends when the reading does."""
    assert s.state.scene is None
    assert s.window.viewer.worker.current is not None
    s.ctx.item_click("//**/Cancel")
    assert s.window.viewer.worker.current is None


def use_the_palette(s: Session) -> None:
    """Its keys keep away from the scrollbar; Enter does the first command that matches, which is lit."""
    s.key(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.p, frames=3)
    box, bar = s.ctx.item_info("//Commands/##command").rect_full, imgui.get_style().scrollbar_size
    right, rows = int(box.max.x - bar), slice(int(box.max.y) + 30, int(box.max.y) + 150)
    seen = s.shot("palette")[rows]
    assert np.ptp(seen[:, right - 100 : right], axis=0).max() > 60  # keys
    assert np.ptp(seen[:, right - 5 : right - 1], axis=0).max() < 10
    s.enter("show depth", frames=3)
    assert s.state.picture.display == "depth"
    assert not s.state.show_palette

    s.key(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.p, frames=3)
    glfw.set_window_size(glfw_window_hello_imgui(), 1100, 600)
    s.wait(lambda: imgui.get_main_viewport().size.x == 1100)
    s.ctx.yield_(3)
    palette = s.ctx.window_info("//Commands").window
    assert abs(palette.pos.x + palette.size.x / 2 - 550) < 2
    glfw.set_window_size(glfw_window_hello_imgui(), 200, 150)
    s.wait(lambda: imgui.get_main_viewport().size.x == 200)
    s.ctx.yield_(3)
    palette = s.ctx.window_info("//Commands").window
    assert palette.pos.x >= 0
    assert palette.pos.x + palette.size.x <= 200
    s.ctx.key_press(imgui.Key.escape)
    glfw.set_window_size(glfw_window_hello_imgui(), 860, 620)
    s.wait(lambda: imgui.get_main_viewport().size.x == 860)
    s.settle()


def look_from_the_broad_side(s: Session) -> None:
    """Without cameras, and upright: the blobs lie beside each other, none behind another."""
    assert s.state.scene.cameras == ()
    assert abs(s.state.view.rotation[2] @ [1, 0, 0]) < 0.5  # along which the blobs lie
    assert abs(s.state.view.rotation[0] @ s.state.view.up) < 1e-6
    rgb = s.shot("bare")
    assert [s.at(rgb, thing).argmax() for thing in CENTRES] == [0, 1, 2]


def use_shortcuts(s: Session) -> None:
    """Chords work everywhere, letters only by themselves and never while typing."""
    key, ctrl, shift = imgui.Key, imgui.Key.mod_ctrl, imgui.Key.mod_shift
    before = s.state.view
    for chord in (ctrl | key.r, ctrl | key.p, ctrl | key.d, ctrl | digit_key(2), ctrl | key.e):
        s.key(chord, frames=3)
    assert s.state.view is before
    assert s.state.picture.display == "rgb"
    assert not list(s.folder.glob("blobs-*.png"))

    s.key(ctrl | key.f, frames=3)
    s.type("far", frames=3)
    assert (s.state.typed, s.state.view is before) == ("far", True)
    s.ctx.key_press(key.f1)  # also while typing
    s.ctx.yield_(2)
    assert s.state.show_help
    s.ctx.key_press(key.f1)
    s.key(key.escape, frames=3)
    assert not imgui.get_io().want_text_input
    assert not s.state.show_help
    s.key(shift | key.f)
    assert s.state.view is not before
    for back, start in ((key.home, (600, 300)), (key.r, (560, 340))):  # apart: never a double click
        s.drag(start, (656, 279))
        s.key(back)
        first = s.state.scene.cameras[0].world_to_camera
        np.testing.assert_allclose(s.state.view.camera(160, 120).world_to_camera, first, atol=1e-9)

    s.ctx.key_press(ctrl | key.s)
    s.wait((s.folder / "blobs-001.png").exists)
    s.type("?", frames=2)
    assert s.state.show_help
    s.ctx.key_press(key.escape)
    use_the_palette(s)
    s.key(ctrl | key.z, frames=2)
    assert s.state.picture.display == "rgb"
    s.key(ctrl | key.o, frames=3)
    assert s.ctx.item_exists("//**/##path")


def use_the_toolbar(s: Session) -> None:
    """Every icon does what its command does, and is lit where that is on; queries are combined by a menu."""
    icons = {command.does: f"//toolbar/{icon_of(command)}" for command in COMMANDS if command.icon}
    for does, icon in icons.items():
        assert s.ctx.item_exists(icon), does
    s.ctx.item_click(icons["show depth"])
    s.click(icons["select: lasso"], frames=2)
    assert (s.state.picture.display, s.state.selection.tool) == ("depth", "lasso")
    s.ctx.item_click(icons["select with no tool: the left button turns the view"])
    for phrase in ("mug", "book"):
        s.search(phrase)
    s.ctx.item_click("//**/mug##phrase of list")
    s.click("//Search/Combine", frames=2)
    s.click("//$FOCUSED/or", frames=2)
    s.click("//**/book##other")
    assert [query.phrase for query in s.state.queries] == ["mug", "book", "mug or book"]
    s.click("//**/Fixed heat scale", frames=2)
    lows, highs = zip(*(query.result.heat_range for query in s.state.shown()), strict=True)
    assert s.state.picture.heat_scale == (min(lows), max(highs))
    s.shot("toolbar")


def icon_of(command: Command) -> str:
    """As `item_exists` takes it."""
    return button_label(command).replace("/", "\\/")


def many_queries(s: Session) -> None:
    """However many there are and however long: the list keeps its place, the newest is on top."""
    display = s.ctx.item_info("//**/Colours").rect_full.min.y
    for phrase in (
        "mug",
        "plant",
        "book or plant",
        "a mug or a book or a plant or another mug or plant",
        "pot",
    ):
        s.search(phrase)
        assert s.ctx.item_info("//**/Colours").rect_full.min.y == display
    closes = [item.rect_full for item in buttons(s, "x")]
    panel = s.ctx.item_info("//Search/Search").rect_full.max.x
    assert closes
    assert len({(rect.min.x, rect.max.x) for rect in closes}) == 1
    assert all(rect.max.x <= panel + 1 for rect in closes)
    phrase = s.state.queries[-1].phrase
    s.shot("many")
    s.click(f"//**/{phrase}/x", frames=2)
    assert phrase not in [query.phrase for query in s.state.queries]
    assert s.ctx.item_info("//**/Colours").rect_full.min.y == display


def buttons(s: Session, label: str) -> list:
    """What the list shows of them."""
    names = [f"//**/{query.phrase}/{label}" for query in s.state.queries]
    return [s.ctx.item_info(name) for name in names if s.ctx.item_exists(name)]


def arrange_panels(s: Session) -> None:
    """Menus do what keys do; panels are closed, opened and moved; the browser opens a scene."""
    s.menu("View", "Show depth")
    s.ctx.yield_(3)
    assert s.state.picture.display == "depth"
    s.menu("Window", "Light theme")
    s.ctx.yield_(3)
    light = s.shot("light")
    assert light[300:500, 5].min() > 150
    whole = s.state.size
    for title in ("Search", "Scene", "Display", "Camera", "Messages"):
        s.menu("Window", f"{title}")
        s.ctx.yield_(3)
    s.settle()
    assert s.state.size[0] == 860 > whole[0]  # the scene has taken their place
    s.key(imgui.Key.mod_ctrl | imgui.Key.f, frames=4)
    s.type("mug", frames=3)
    assert s.state.typed == "mug"  # the panel is open again, and its box has the keyboard
    s.ctx.key_press(imgui.Key.escape)
    s.menu("Window", "Panels as at first")
    s.ctx.yield_(5)
    for title in ("Scene", "Display", "Camera", "Messages"):
        if not s.ctx.item_exists(f"//{title}"):
            s.menu("Window", f"{title}")
    s.settle()
    s.key(imgui.Key.mod_ctrl | imgui.Key.o, frames=4)
    assert s.state.browser.folder == s.folder.absolute()
    s.shot("browser")
    s.ctx.item_click("//**/plain.ply")
    s.wait(lambda: s.state.path.name == "plain.ply")
    s.settle()
    assert s.state.browser is None
    s.key(imgui.Key.mod_ctrl | imgui.Key.o, frames=4)
    s.key(imgui.Key.escape, frames=3)
    assert s.state.browser is None


def leave_settings(s: Session) -> None:
    """The next window finds them; see `find_settings`."""
    assert s.state.show_help  # at the first start
    s.ctx.key_press(imgui.Key.escape)
    s.menu("Window", "Light theme")
    for title in ("Select", "Train", "Record"):  # which do not lie over the search the next time
        s.menu("Window", title)
    s.menu("Window", "Display")
    s.ctx.yield_(3)
    s.ctx.key_press(imgui.Key.f11)  # hidden at the end, there again the next time
    s.settle()
    assert s.state.size[0] == 860


def find_settings(s: Session) -> None:
    """What `leave_settings` has left."""
    assert not s.state.show_help
    assert s.state.preferences.theme == "light"
    assert [Path(path).name for path in s.state.preferences.recent] == ["blobs.ply"]
    assert s.state.size[0] < 700
    assert s.ctx.item_exists("//**/##phrase")
    assert not s.ctx.item_exists("//**/Colours")
    s.shot("found")


def type_while_opening(s: Session) -> None:
    """A word meant for the box that cannot be typed in yet is no row of keys."""
    assert s.state.scene is None
    box = s.ctx.item_info("//**/##phrase").rect_full
    s.ctx.mouse_teleport_to_pos((box.min.x + 20, (box.min.y + box.max.y) / 2))
    s.ctx.yield_()
    s.ctx.mouse_click(0)
    s.ctx.yield_(2)
    assert s.state.letters_muted
    for key in (imgui.Key.p, imgui.Key.tab, imgui.Key.f):
        s.ctx.key_press(key)
    s.ctx.yield_(2)
    assert s.state.show_panel
    assert not any("picture" in message.text for message in s.state.messages)
    s.ctx.mouse_teleport_to_pos((600, 400))
    s.ctx.mouse_click(0)
    s.ctx.yield_(2)
    assert not s.state.letters_muted
    s.wait(lambda: s.state.scene is not None)


def travel_by_keys(s: Session) -> None:
    """Esc closes a menu; Tab goes from field to field, and the panels stay; the palette knows everything."""
    s.ctx.item_click("//**/##MenuBar/View")
    assert imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    s.key(imgui.Key.escape, frames=2)
    assert not imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    s.key(imgui.Key.mod_ctrl | imgui.Key.f, frames=4)
    seen = set()
    for _ in range(12):
        s.key(imgui.Key.tab, frames=2)
        seen.add(imgui.internal.get_focus_id())
    assert len(seen) > 5
    assert s.state.show_panel
    for words, done in (
        ("light theme", lambda: s.state.preferences.theme == "light"),
        ("letters of 125", lambda: s.state.preferences.ui_scale == 1.25),
        ("open plain", lambda: s.state.path.name == "plain.ply"),
    ):
        if words == "open plain":
            s.state.preferences = with_recent(s.state.preferences, s.folder / "plain.ply")
        s.key(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.p, frames=3)
        s.ctx.key_chars_append_enter(words)
        s.wait(done)
        s.settle()
    s.key(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.p, frames=3)
    s.ctx.key_chars("show")  # arrows choose another command than the first
    s.ctx.yield_(2)
    for _ in range(3):
        s.key(imgui.Key.down_arrow, frames=2)
    s.key(imgui.Key.enter, frames=3)
    assert s.state.picture.display == "depth"
    s.key(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.p, frames=3)
    s.enter("teleport", frames=3)
    assert s.state.show_palette


def end_by_signals(s: Session) -> None:
    """What is not saved is asked about, and a film is waited for."""
    viewer = s.window.viewer
    viewer.recorder.submit("a film", slow_film, print, print)
    selecting.quit_viewer(viewer)
    s.wait(lambda: s.state.selection.leaving is not None)
    s.shot("film")
    s.click("//**/Stay", frames=2)
    assert not s.state.selection.may_close
    viewer.recorder.cancel()
    s.search("mug")
    s.menu("Select", "Select what the search found")
    s.key(imgui.Key.delete)
    s.window.signals.append(signal.SIGINT)
    s.wait(lambda: s.state.selection.leaving is not None)
    assert not s.state.selection.may_close
    s.shot("asked")
    s.click("//**/Cancel", frames=2)


def slow_film(progress) -> None:
    for step in range(2000):
        progress("a film", step / 2000)
        time.sleep(0.05)


def look_at_nothing(s: Session) -> None:
    """A scene of which nothing can be drawn says so over the picture."""
    assert "none of the 360 Gaussians can be drawn" in s.state.nothing
    said = s.shot("nothing")[250:370, 400:]
    assert said.max() > 150


def slow_load(path: Path) -> Scene:
    time.sleep(1.0)
    return load_scene(path)


OPENED = {  # scene and request of the scenarios that do not just open "blobs.ply"
    "without_field": ("plain.ply", {}),
    "from_the_command_line": (
        "blobs.ply",
        {
            "queries": ("mug", "sofa", "plant"),
            "picture": PictureConfig(display="segmentation"),
            "level": "whole",
            "camera": "2",
            "orthographic": 4.0,
        },
    ),
    "leave_settings": ("blobs.ply", {"settings": Path("settings")}),
    "find_settings": ("blobs.ply", {"settings": Path("settings")}),
    "type_while_opening": ("blobs.ply", {"load": slow_load}),
    "close_while_opening": ("blobs.ply", {"load": slow_load}),
    "look_from_the_broad_side": ("wide.ply", {}),
    "look_at_nothing": ("nothing.ply", {}),
    "large_letters": ("blobs.ply", {"size": (1280, 720)}),
}


def play_one(arguments: list[str]) -> None:
    """Play the scenario that is the function of that name, here or in one of the modules of scenarios."""
    name, folder = arguments
    known = {**vars(scenarios_scene), **vars(scenarios_panels), **globals()}
    scene, request = OPENED.get(name, ("blobs.ply", {}))
    Session(Path(folder), scene, **request).run(known[name])
    print("PASSED")


if __name__ == "__main__":
    serve(play_one)
