"""A long day at the window: 100 scenes opened and closed, and actions in each; run by test_window.py.

    python -m tests.viewer.soak_driver BACKEND FOLDER ACTIONS

ACTIONS are done in each scene. FOLDER holds SCENES; what is saved goes to a new folder in it. Prints one line
of JSON for each of `MARKS`: what the process holds when so many scenes have been opened.
"""

import ctypes
import gc
import json
import os
import random
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from imgui_bundle import hello_imgui  # isort: skip
import moderngl
import psutil

from langsplat_core.query.answers import QueryResult
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from langsplat_viewer.actions import editing, opening, queries, settings
from langsplat_viewer.commands import COMMANDS
from langsplat_viewer.jobs import give_memory_back
from langsplat_viewer.panels.layout import all_panels
from langsplat_viewer.rendering.renderer import Backend, Renderer, renderer_for
from langsplat_viewer.rendering.request import Clip, Splats
from tests.viewer.window_driver import Session

SCENES = ("blobs.ply", "plain.ply", "many.ply", "bare.ply", "few.ply")
OPENED = 100
MARKS = (10, *range(20, 101, 20))  # after so many scenes it is said what is held
PHRASES = ("mug", "book", "plant", "mug or plant", "book, plant", "sofa", "mug left of plant")
# These wait for a person, draw for minutes, or end it.
LEFT_OUT = ("save a film of the path", "quit")
TOO_LARGE = ("text size 250 %", "text size 300 %")  # for the window
MOST_NAMES = 20_000  # of OpenGL objects that are looked at; drivers give the lowest that is free


class GlCount:
    """How many OpenGL objects the current context holds."""

    KINDS = ("Texture", "Buffer", "Framebuffer", "VertexArray", "Program")

    def __init__(self) -> None:
        self._library = ctypes.CDLL("libGL.so.1")

    def __call__(self) -> dict[str, int]:
        return {kind.lower(): self._of(kind) for kind in self.KINDS}

    def _of(self, kind: str) -> int:
        is_one = getattr(self._library, f"glIs{kind}")
        is_one.restype = ctypes.c_ubyte
        return sum(bool(is_one(name)) for name in range(1, MOST_NAMES))


class SoakSession(Session):
    """A window with the renderer of a backend, whose thread can be told what to do."""

    patience = 3600.0
    watched = True

    def __init__(self, folder: Path, backend: Backend) -> None:
        self._wanted: Callable[[], object] | None = None  # at the next frame
        super().__init__(folder, SCENES[0], backend=backend)

    def _make_renderer(self, ctx: moderngl.Context) -> Renderer:
        return renderer_for(ctx, self.backend)

    def params(self) -> hello_imgui.RunnerParams:
        params = super().params()
        drawn = params.callbacks.show_gui

        def gui() -> None:
            drawn()
            if self._wanted is not None:
                self._wanted()
                self._wanted = None

        params.callbacks.show_gui = gui
        return params

    def do(self, step: Callable[[], object]) -> None:
        """On the thread that draws, as keys and panels do, and a frame more."""
        self._wanted = step
        self.wait(lambda: self._wanted is None)
        self.ctx.yield_()


class Soak:
    """What is done to one window."""

    def __init__(self, session: SoakSession, actions: int, seed: int = 0) -> None:
        self.actions = actions  # in each scene
        self.s, self.viewer, self.state = session, session.window.viewer, session.state
        self.rng = random.Random(seed)
        self.count_gl = GlCount()

    def run(self, s: Session) -> None:
        """All of it."""
        s.wait(lambda: self.state.scene is not None)
        done = 0
        for opened in range(1, OPENED + 1):
            self.open(SCENES[opened % len(SCENES)])
            for _ in range(self.actions):
                self.act()
                done += 1
            if opened in MARKS:
                print(json.dumps({"scenes": opened, "actions": done} | self.held()), flush=True)

    def open(self, name: str) -> None:
        """As a person does: dropped, from the file browser, or from the list; what was deleted is let go."""
        path = self.s.folder / name
        way = self.rng.choice(("dropped", "browsed", "listed"))
        if way == "dropped":
            self.s.do(lambda: self.s.window.drop([str(path)]))
        elif way == "browsed":
            self.s.do(lambda: opening.ask_for_file(self.viewer))
            self.s.ctx.yield_(3)
            self.s.ctx.item_click(f"//**/{name}")
        else:
            self.s.do(lambda: opening.add_scenes(self.viewer, [path]))
            self.s.do(lambda: opening.switch_scene(self.viewer, path.absolute()))
        self.s.ctx.yield_(3)
        if self.state.leaving is not None:
            self.s.ctx.item_click("//**/Discard")
        self.s.wait(lambda: self.state.opening is None and self.state.path.name == name)
        self.settle()

    def act(self) -> None:
        """One action, in one of the many ways, and a few frames for it."""
        way = self.rng.choice((self.command, self.search, self.of_queries, self.look, self.with_mouse))
        way()
        self.s.ctx.yield_(2)
        state = self.state
        if state.browser is not None or state.show_help or state.show_palette:  # over the search
            self.s.do(lambda: settings.escape(self.viewer))
        if self.rng.random() < 0.2:
            self.settle()

    def settle(self) -> None:
        self.s.wait(lambda: not self.viewer.worker.is_running and not self.s.window.unfinished)
        self.s.ctx.yield_(2)

    def command(self) -> None:
        row = self.rng.choice([row for row in COMMANDS if row.does not in LEFT_OUT + TOO_LARGE])
        self.s.do(lambda: row.act(self.viewer))

    def search(self) -> None:
        box = "//**/##phrase"
        if self.s.ctx.item_exists(box):
            self.s.search(self.rng.choice(PHRASES))
        else:
            self.s.do(lambda: queries.ask(self.viewer, self.rng.choice(PHRASES)))

    def of_queries(self) -> None:
        """What the list of queries offers, and undoing."""
        viewer, rng = self.viewer, self.rng
        self.s.do(lambda: queries.set_level(viewer, rng.choice(("auto", "subpart", "part", "whole"))))
        for query in rng.sample(self.state.session.queries, min(2, len(self.state.session.queries))):
            act = rng.choice((queries.show, queries.hide, queries.remove))
            self.s.do(partial(act, viewer, query.phrase))
            self.s.do(partial(queries.set_cut, viewer, query.phrase, rng.choice((None, 0.6, 0.7))))
        self.s.do(partial(rng.choice((editing.undo, editing.redo)), viewer))

    def look(self) -> None:
        """What sliders and boxes of the panels do."""
        viewer, rng = self.viewer, self.rng
        steps: tuple[Callable[[], object], ...] = (
            lambda: settings.set_picture(viewer, replace(self.state.session.picture, dim=rng.random())),
            lambda: viewer.change(splats=Splats(rng.uniform(0.1, 1), rng.randrange(4))),
            lambda: settings.set_clip(viewer, Clip(rng.uniform(0, 3), rng.uniform(5, 9))),
            lambda: settings.prefer(viewer, ui_scale=rng.choice((0.8, 1.0, 1.5))),
            lambda: settings.open_panel(viewer, rng.choice(all_panels()).title),
            lambda: queries.set_canonical(viewer, ()),
            lambda: editing.undo(viewer),
        )
        self.s.do(rng.choice(steps))

    def with_mouse(self) -> None:
        """A drag in the scene, with whichever tool there is, and the wheel."""
        start, end = ((self.rng.randint(450, 800), self.rng.randint(150, 500)) for _ in range(2))
        self.s.drag(start, end, frames=1, steps=3)
        self.s.ctx.mouse_wheel_y(self.rng.choice((-1, 1)))

    def held(self) -> dict[str, object]:
        """What there is, once nothing is under way."""
        self.settle()
        gc.collect()
        give_memory_back()  # as a window that rests does
        kinds = (Scene, QueryEngine, QueryResult)
        alive = {kind.__name__: sum(type(thing) is kind for thing in gc.get_objects()) for kind in kinds}
        found: dict[str, object] = {}

        self.s.do(lambda: found.update(self.count_gl()))
        return {"MB": round(psutil.Process().memory_info().rss / 1e6, 1)} | alive | found


if __name__ == "__main__":
    session = SoakSession(Path(sys.argv[2]), sys.argv[1])
    saved = Path(sys.argv[2]) / "saved"  # the list of scenes stays short enough to be seen whole
    saved.mkdir()
    os.chdir(saved)
    soak = Soak(session, int(sys.argv[3]))
    session.run(soak.run)
    print("PASSED")
