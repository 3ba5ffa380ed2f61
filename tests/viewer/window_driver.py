"""Drives the real window through imgui's test engine; run by test_window.py in a process of its own.

Arguments: SCENARIO FOLDER, the working folder with the scenes. A scenario asserts and ends with "PASSED".
"""

import gc
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import reduce
from operator import or_
from pathlib import Path
from shutil import copyfile
from threading import Event, Timer

import numpy as np
from PIL import Image

from tests.support.windowless import answer, result

from imgui_bundle import ImVec2, hello_imgui, imgui  # isort: skip
from imgui_bundle.immapp import testing  # isort: skip
from langsplat_core.config import PictureConfig
from langsplat_core.errors import BackendError
from langsplat_core.io.scenes import load_scene
from langsplat_core.pipeline.report import PREVIEW
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from langsplat_viewer.actions import outline, queries, saving, settings
from langsplat_viewer.options import ViewerOptions
from langsplat_viewer.panels import layout
from langsplat_viewer.panels.ui import scene_area
from langsplat_viewer.rendering.renderer import Backend, Renderer, renderer_for
from langsplat_viewer.viewer import Services, Viewer
from langsplat_viewer.window import Window
from tests.support.fakes import CENTRES, FakeEncoder
from tests.support.processes import serve
from tests.viewer import scenarios

MUG, BOOK, PLANT = CENTRES
PATIENCE = 240.0  # seconds: other tests may have the cores
Place = tuple[float, float]  # in the window


class Session:
    """A window under test."""

    patience = PATIENCE
    watched = False  # frames are drawn: not those that no picture is taken of

    def __init__(
        self,
        folder: Path,
        scene: str | None,
        load=load_scene,
        size: str = "1040x620",
        backend: Backend = "opengl",
        remembered: Path | None = None,
        **options,
    ) -> None:
        self.folder = folder
        # The scenario begins while the scene is read, or before one is.
        self.is_slow = load is not load_scene or scene is None
        self.drawn = 0  # pictures
        services = Services(load, lambda encoder_id: FakeEncoder())
        path = None if scene is None else folder / scene
        wanted = ViewerOptions(size=size, backend=backend, **options)
        self.window = Window(path, wanted, services, self._make_renderer, remembered)
        self.window.idles = False
        self.window.files.open_system = lambda choice: None
        self.window.toasts.seconds = 0.0  # they would cover what is looked at
        self.state = self.window.viewer.state

    def _make_renderer(self, ctx, backend: Backend) -> Renderer:
        self.renderer = renderer = renderer_for(ctx, backend)
        draw = renderer.draw

        def counted(request, targets) -> None:
            self.drawn += len(targets)
            draw(request, targets)

        renderer.draw = counted
        return renderer

    def run(self, test: Callable[["Session"], None], folds: bool = True) -> None:
        """Run a scenario, with the search as it is at first or folded."""

        def body(ctx) -> None:
            self.ctx = ctx
            engine = imgui.test_engine.get_io(hello_imgui.get_imgui_test_engine())
            engine.config_watchdog_warning = engine.config_watchdog_kill_test = self.patience
            if not self.is_slow:
                self.wait(lambda: self.state.open is not None)
                self.settle()
            if folds:
                self.fold()
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

    @property
    def viewer(self) -> Viewer:
        return self.window.viewer

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
        self.wait(lambda: self.viewer.worker.current is None and self.state.glide is None)
        self.wait(lambda: not self.window.unfinished)
        self.ctx.yield_(2)

    def until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition, then settle."""
        self.wait(condition)
        self.settle()

    def shows(self, name: str) -> None:
        """Wait until the scene of that file is shown."""
        self.until(lambda: self.state.path.name == name)

    def draws_nothing(self) -> None:
        """A picture is drawn again only when something changed."""
        drawn = self.drawn
        self.ctx.yield_(20)
        assert self.drawn == drawn

    def rest(self, frames: int) -> None:
        """Let so many frames pass, or, for 0, wait until it is settled."""
        if frames:
            self.ctx.yield_(frames)
        else:
            self.settle()

    def key(self, chord: str, frames: int = 0) -> None:
        """Press "F", "Ctrl+Shift+P" or "up_arrow", then `rest`."""
        *held, last = chord.lower().split("+")
        keys = [imgui.Key[f"mod_{name}"] for name in held]
        self.ctx.key_press(reduce(or_, keys, imgui.Key[f"_{last}" if last.isdigit() else last]))
        self.rest(frames)

    def click(self, item: str, frames: int = 0) -> None:
        """Click an item, then `rest`."""
        self.ctx.item_click(item)
        self.rest(frames)

    def type(self, text: str, frames: int = 2) -> None:
        """Type characters, then let so many frames pass."""
        self.ctx.key_chars(text)
        self.ctx.yield_(frames)

    def drop(self, *names: str) -> None:
        """Drop files of the folder onto the window, and settle."""
        self.window.drop([str(self.folder / name) for name in names])
        self.settle()

    def enter(self, text: str) -> None:
        """Type characters and Enter, then `rest`."""
        self.ctx.key_chars_append_enter(text)
        self.rest(0)

    def click_at(self, place: Place) -> None:
        """Click a place, in window units, then `rest`."""
        self.ctx.mouse_teleport_to_pos(place)
        self.ctx.yield_(2)
        self.ctx.mouse_click(0)
        self.rest(0)

    def open_panel(self, title: str, frames: int = 0) -> None:
        """Open a panel, then `rest`."""
        settings.open_panel(self.viewer, title)
        self.rest(frames)

    def shot(self, name: str) -> np.ndarray:
        """Return (H, W, 3) the whole window."""
        self.settle()
        self.capture(path := self.folder / f"{name}.png")
        return image(path)

    def capture(self, path: Path) -> None:
        """The window as it is."""
        before, self.watched = self.watched, True
        self.ctx.yield_(2)
        testing.capture(self.ctx, str(path))
        self.watched = before

    def on_screen(self, point: np.ndarray) -> tuple[float, float]:
        """Return where a world point is in the window."""
        area, (pixels, _) = scene_area(), self.state.open.view.camera(*self.state.size).project(point[None])
        return float(pixels[0, 0] + area.left), float(pixels[0, 1] + area.top)

    def at(self, shot: np.ndarray, point: np.ndarray) -> np.ndarray:
        """Return (3,) mean colour of the 5 x 5 pixels around a world point."""
        column, row = map(int, self.on_screen(point))
        return shot[row - 2 : row + 3, column - 2 : column + 3].reshape(-1, 3).mean(0)

    def drag(self, start: Place, end: Place, frames: int = 0, steps: int = 8) -> None:
        """Drag from place to place, then `rest`."""
        with self.dragging(start, end, steps):
            pass
        self.rest(frames)

    @contextmanager
    def dragging(self, start: Place, end: Place, steps: int = 8) -> Iterator[None]:
        """The left button is held at the end of a way, in window units, that has a frame for each step."""
        self.ctx.mouse_teleport_to_pos(start)
        self.ctx.mouse_down(0)
        for x, y in np.linspace(start, end, steps):
            self.ctx.mouse_teleport_to_pos((x, y))
            self.ctx.yield_()
        yield
        self.ctx.mouse_up(0)

    def menu(self, name: str, item: str) -> None:
        """Click an item of a menu, and settle."""
        self.ctx.item_click(f"//**/##MenuBar/{name}")
        self.click(f"//$FOCUSED/{item}")

    def search(self, phrase: str, stay: bool = False) -> None:
        was_open = "Search" in self.state.preferences.panels
        self.open_panel("Search", frames=3)
        self.ctx.item_click("//**/##phrase")
        self.enter(phrase)
        if not stay:  # in the box
            self.key("escape", frames=2)
            if not was_open:
                self.fold()

    def fold(self) -> None:
        """Fold the search, which floats over what many scenarios look at."""
        settings.turn_panel(self.viewer, "Search", is_open=False)
        self.rest(2)


def image(path: Path) -> np.ndarray:
    """Return (H, W, 3)"""
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def look_and_search(s: Session) -> None:
    rgb = s.shot("rgb")
    assert [s.at(rgb, thing).argmax() for thing in CENTRES] == [0, 1, 2]
    s.draws_nothing()
    find_the_plant(s, rgb)
    both = find_more(s)
    try_displays(s, both, panel=rgb[540, 1035])
    use_keys(s)
    save_with_a_key(s)


def find_the_plant(s: Session, rgb: np.ndarray) -> None:
    before = s.state.open.view
    s.search("plant")
    assert list(s.folder.glob("blobs-*.png")) == []  # its p saves no picture
    assert result(s, 0).found
    s.key("F")
    np.testing.assert_allclose(s.state.open.view.target, result(s, 0).place)
    s.key("R")
    heat = s.shot("heat")
    assert is_hot(s.at(heat, PLANT))  # it is blue
    dimmed = PictureConfig().dim * s.at(rgb, BOOK)  # as is the rest
    np.testing.assert_allclose(s.at(heat, BOOK), dimmed, atol=6)

    # The heat stays on the thing while the camera moves round it. Blended relevancy depends on the view:
    # the colour may be another hot one.
    s.drag((600, 300), (656, 279))
    assert s.state.open.view is not before
    assert is_hot(s.at(s.shot("moved"), PLANT))
    assert not is_hot(s.at(rgb, PLANT))


def is_hot(colour: np.ndarray) -> bool:
    return bool(colour[0] > colour[2] + 40 and colour[1] > colour[2])


def find_more(s: Session) -> np.ndarray:
    s.search("sofa", stay=True)
    assert "sofa" in answer(s, 1).problem
    assert s.state.shown() == []  # nor is what was asked before it
    s.key("escape", frames=2)
    assert [query.phrase for query in s.state.session.queries] == ["plant"]
    queries.show(s.viewer, "plant")
    s.click("//**/Add")  # new answers
    s.fold()
    s.search("mug")
    s.key("R")  # from where the view has moved aside
    return s.shot("both")


def try_displays(s: Session, both: np.ndarray, panel: np.ndarray) -> None:
    """Every display is another picture; `panel` is a pixel of the panel, which none of them may colour."""
    seen = [both]
    for label in ("Colours", "Depth", "Alpha", "Segmentation", "Subpart##latent", "Whole##latent"):
        s.ctx.item_click(f"//**/{label}")
        shot = s.shot(label.replace("#", ""))
        assert all(np.abs(shot[:, :700] - other[:, :700]).max() > 30 for other in seen), label
        assert (shot[540, 1035] == panel).all(), f"{label} coloured the panel"
        seen.append(shot)


def use_keys(s: Session) -> None:
    """Keys, away from the box."""
    s.click_at((600, 550))
    displays = ("rgb", "depth", "alpha", "relevancy", "segmentation", "latent", "latent")
    for digit, display in enumerate(displays, start=1):
        s.key(str(digit), frames=2)
        assert s.state.session.picture.display == display
    assert s.state.session.latent_level == 1
    s.key("1", frames=1)
    s.key("R")
    assert s.state.session.picture.display == "rgb"
    width = s.state.size[0]
    s.key("f11")
    assert s.state.size[0] == 1040
    assert width < 800
    s.key("f11")


def save_with_a_key(s: Session) -> None:
    s.key("P", frames=2)
    saved, (width, height), area = image(s.folder / "blobs-001.png"), s.state.size, scene_area()
    assert saved.shape == (height, width, 3)
    shown = s.shot("saved")[int(area.top) :, int(area.left) :]
    clear = np.s_[:440, 100:width]  # left of it the toolbar, below the cursor
    np.testing.assert_allclose(saved[clear], shown[clear], atol=3)
    assert not list(s.folder.glob("*.ini"))


def without_field(s: Session) -> None:
    assert not s.ctx.item_exists("//**/##phrase")
    (s.folder / "images").mkdir()
    (s.folder / "images" / "1.jpg").touch()
    s.click("//**/Train one ...")
    form = s.state.training_form
    assert (form.gaussians, form.dataset) == (str(s.folder / "plain.ply"), str(s.folder))
    assert s.ctx.item_exists("//**/##Gaussians")
    s.key("4", frames=1)  # relevancy: refused with a line, not a crash
    assert s.state.session.picture.display == "rgb"
    s.ctx.mouse_move_to_pos(s.on_screen(BOOK))
    s.ctx.mouse_click(1)
    s.ctx.yield_(3)
    assert not s.ctx.item_exists("//**/##name this")  # nor anything else of which each would be refused

    copyfile(s.folder / "plain.ply", s.folder / PREVIEW)  # of a training that was stopped
    s.drop(PREVIEW)
    assert not s.ctx.item_exists("//**/Train one ...")  # but Train goes on
    s.drop("plain.ply")
    s.drop("truncated.ply")
    assert s.state.messages[-1].is_error
    assert "truncated.ply" in s.state.messages[-1].text
    assert s.state.path.name == "plain.ply"
    s.drop("blobs.ply")
    s.shows("blobs.ply")
    assert s.ctx.item_exists("//**/##phrase")
    s.open_panel("Scene", frames=3)
    s.ctx.item_click("//**/First steps")
    s.open_panel("Camera", frames=3)
    s.ctx.item_click("//**/##next")
    s.until(lambda: s.state.camera_index == 1)


def from_the_command_line(s: Session) -> None:
    assert [query.phrase for query in s.state.session.queries] == ["mug", "sofa", "plant"]
    assert [s.state.result(query) is not None for query in s.state.session.queries] == [True, False, True]
    assert s.state.session.picture.display == "latent"
    assert s.state.session.level == "whole"
    expected = s.state.open.scene.cameras[2]
    np.testing.assert_allclose(s.state.open.view.eye, expected.position, atol=1e-9)
    np.testing.assert_allclose(s.state.open.view.rotation, expected.rotation, atol=1e-9)
    assert s.state.open.view.orthographic
    assert abs(s.state.open.view.span - 4.0) < 1e-9


def broken_renderer(s: Session) -> None:
    """A driver that fails while drawing: the window lives on and says so once."""

    def fail(*args, **kwargs) -> None:
        raise BackendError("the driver gave up; use --backend cpu")

    draw, s.renderer.draw = s.renderer.draw, fail
    s.key("2")
    s.ctx.yield_(20)
    assert s.state.messages[-1].text == "the driver gave up; use --backend cpu"
    s.renderer.draw = draw
    s.key("3", frames=1)
    assert s.shot("mended")[:, 400:].max() > 100


def broken_panel(s: Session) -> None:
    """A panel that fails half way, as one of an extension may: it is closed, and the window lives on."""

    def draw(viewer: Viewer) -> None:
        imgui.begin_disabled(False)
        imgui.begin_child("inside")
        raise RuntimeError("of the extension")

    layout.CORE_PANELS = (*layout.CORE_PANELS, layout.Panel("Broken", draw))
    s.open_panel("Broken")
    s.until(lambda: "Broken" not in layout.opened(s.state))
    said = "the panel Broken was closed: internal error: RuntimeError: of the extension"
    assert s.state.messages[-1].text == said
    s.key("3", frames=1)
    assert s.shot("without it")[:, 400:].max() > 100


READ_ON = Event()


def slow_load(path: Path) -> Scene:
    """As long as the scenario wants it to."""
    assert READ_ON.wait(PATIENCE)
    return load_scene(path)


def close_while_opening(s: Session) -> None:
    """The window may be closed at any time; the process ends when the reading does."""
    assert s.state.open is None
    assert s.viewer.worker.current is not None
    assert outline.wanted(s.viewer).problem == "opening blobs.ply ..."
    s.ctx.item_click("//**/Cancel")
    assert s.viewer.worker.current is None
    Timer(1.0, READ_ON.set).start()  # when the window is closed


def end_by_signals(s: Session) -> None:
    """What is not saved is asked about, and a film is waited for."""
    drawn = Event()
    s.viewer.recorder.submit("a film", lambda progress: drawn.wait(PATIENCE), print, print)
    saving.quit_viewer(s.viewer)
    s.until(lambda: s.state.leaving is not None)
    s.click("//**/Stay", frames=2)
    assert not s.state.may_close
    s.viewer.recorder.cancel()
    drawn.set()
    s.search("mug")
    s.menu("Select", "Select what the search found")
    s.key("delete")
    s.window.signals.append(signal.SIGINT)
    s.until(lambda: s.state.leaving is not None)
    assert not s.state.may_close
    s.click("//**/Cancel", frames=2)


def open_many_scenes(s: Session) -> None:
    """Nothing of a scene that was left is held: neither its arrays nor its answers."""
    for _ in range(6):
        for name in ("plain.ply", "blobs.ply"):
            s.drop(name)
            s.shows(name)
        queries.ask(s.viewer, "mug")
        s.settle()
    gc.collect()
    kinds = (Scene, QueryEngine, QueryResult)
    alive = [sum(type(thing) is kind for thing in gc.get_objects()) for kind in kinds]
    assert (np.array(alive) <= (8, 1, 20)).all(), alive


def look_at_nothing(s: Session) -> None:
    """A scene of which nothing can be drawn says so over the picture."""
    assert "none of the 360 Gaussians can be drawn" in s.state.nothing
    assert s.shot("nothing")[250:370, 400:].max() > 150


ASKED = {
    "query": ("mug", "sofa", "plant"),
    "display": "latent",  # and not the heat of the answers
    "level": "whole",
    "camera": "2",
    "orthographic": 4.0,
}
OPENED = {  # scene and request of the scenarios that do not just open "blobs.ply"
    "without_field": ("plain.ply", {}),
    "from_the_command_line": ("blobs.ply", ASKED),
    "leave_settings": ("blobs.ply", {"remembered": Path("settings")}),
    "begin_at_the_start_page": (None, {"remembered": Path("settings")}),
    "find_settings": ("blobs.ply", {"remembered": Path("settings")}),
    "close_while_opening": ("blobs.ply", {"load": slow_load}),
    "look_at_nothing": ("nothing.ply", {}),
    "large_letters": ("blobs.ply", {"size": "1280x720"}),
}


KEEPS_SEARCH = {  # open, as it is at first
    *("without_field", "begin_at_the_start_page", "find_settings", "offers_keep_still", "many_queries"),
    *("arrange_panels", "leave_settings", "travel_by_keys", "use_shortcuts", "large_letters"),
    "do_without_a_mouse",
}


def play_one(arguments: list[str]) -> None:
    """Play the scenario that is the function of that name, here or among the scenarios."""
    name, folder = arguments
    known = {**vars(scenarios), **globals()}
    scene, options = OPENED.get(name, ("blobs.ply", {}))
    Session(Path(folder), scene, **options).run(known[name], folds=name not in KEEPS_SEARCH)
    print("PASSED")


if __name__ == "__main__":
    serve(play_one)
