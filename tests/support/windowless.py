"""A viewer without a window: a fake picture, fake files, and frames on demand."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from langsplat_core.errors import FormatError
from langsplat_core.scene import Scene
from langsplat_viewer.actions import opening, queries, selecting, settings, viewpoint
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.rendering.request import Clip, RenderRequest, Splats
from langsplat_viewer.state import GLIDE_SECONDS, ViewerState
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene

SCENES = {
    "blobs.ply": blob_scene(),
    "plain.ply": blob_scene(field=False),
    "bare.ply": blob_scene(with_cameras=False),
    "book.ply": blob_scene(phrasebook=True),
}


class FakeSurface:
    """A picture of one colour whose surface is a plane through the origin."""

    def point_at(self, u: float, v: float):
        return None if u > 0.9 else np.array([u - 0.5, v - 0.5, 0.0])

    def depths(self):
        """Nothing is drawn, so that nothing is hidden."""
        return np.zeros((12, 16), np.float32)

    def capture(self, request: RenderRequest):
        return np.full((6, 8, 3), 77, np.uint8)


class FakeRenderer:
    """Notes the requests it draws, and takes as long as it is told to, on a clock of its own."""

    backend = "fake"

    def __init__(self, seconds: float = 0.0) -> None:
        self.drawn: list[RenderRequest] = []
        self.seconds = seconds  # that an image takes
        self.now = 0.0
        self.nothing = False  # whether images show nothing
        self.depth: float | None = None  # of the surface; None: 2 in the right half

    def clock(self) -> float:
        return self.now

    def forget(self) -> None:
        pass

    def ahead(self, request: RenderRequest) -> None:
        return None

    def draw(self, request: RenderRequest, targets) -> None:
        self.drawn.append(request)
        self.now += self.seconds
        for target in targets:
            target.clear(1.0, 0.0, 0.0, 1.0)

    def shows_nothing(self) -> bool:
        return self.nothing

    def depth_at(self, request: RenderRequest, x_px: float, y_px: float) -> float | None:
        return self.depth or (2.0 if x_px > 100 else None)


def load(path: Path) -> Scene:
    if path.name not in SCENES:
        raise FormatError(f"{path}: broken; export it again")
    return SCENES[path.name]


def settle(viewer: Viewer, seconds: float = 120.0) -> None:
    """Frames until the worker has nothing left to do."""
    end = time.monotonic() + seconds
    while viewer.worker.current is not None:
        assert time.monotonic() < end, "the worker never finished"
        viewer.take_results()
        viewpoint.tick(viewer, 0.0)
        time.sleep(0.002)
    viewer.take_results()
    viewpoint.tick(viewer, 0.0)


def act(action: Callable[..., object], viewer: Viewer, *arguments: object, **options: object) -> None:
    """Do something, and wait until the worker has done what that began."""
    action(viewer, *arguments, **options)
    settle(viewer)


def go(action: Callable[..., object], viewer: Viewer, *arguments: object) -> None:
    """Do something, and let the camera that it sends gliding arrive."""
    action(viewer, *arguments)
    arrive(viewer)


def open_scene(viewer: Viewer, path: Path | str) -> None:
    """Open a scene, and wait until it is shown."""
    act(opening.open_scene, viewer, Path(path))


def ask(viewer: Viewer, *phrases: str) -> None:
    """Search for phrases, and wait for the answers."""
    for phrase in phrases:
        queries.ask(viewer, phrase)
    settle(viewer)


def recorded(viewer: Viewer, seconds: float = 60.0) -> None:
    """Until the recorder has nothing left to do."""
    end = time.monotonic() + seconds
    while viewer.recorder.current is not None:
        assert time.monotonic() < end, "never finished"
        viewer.take_results()
        time.sleep(0.002)
    viewer.take_results()


def arrive(viewer: Viewer) -> None:
    """Let a gliding camera arrive."""
    viewpoint.tick(viewer, viewer.clock + 2 * GLIDE_SECONDS)


def phrases(viewer: Viewer) -> list[str]:
    """Of the queries, in their order."""
    return [query.phrase for query in viewer.state.queries]


def errors(viewer: Viewer) -> list[str]:
    return [message.text for message in viewer.state.messages if message.is_error]


CHANGES = {  # of what is seen, after a search
    "display": lambda v: settings.set_display(v, "depth"),
    "hidden query": lambda v: queries.hide(v, v.state.queries[0]),
    "splats": lambda v: settings.set_splats(v, Splats(0.5)),
    "near cut": lambda v: settings.set_clip(v, Clip(1.0)),
    "marks": selecting.select_all,
    "size": lambda v: settings.resize(v, 100, 80),
    "view": lambda v: viewpoint.look_from(v, "left"),
}


def on_screen(canvas: Canvas) -> list[np.ndarray]:
    """(H, W, 3) bytes of each pane."""
    raw = [(np.frombuffer(texture.read(), np.uint8), texture.size) for texture in canvas.textures]
    return [pixels.reshape(height, width, 4)[::-1, :, :3] for pixels, (width, height) in raw]


def rest(canvas: Canvas, state: ViewerState, now: float) -> None:
    """Update until the fine picture is there, whoever rasterizes it."""
    end = time.monotonic() + 60
    while canvas.update(state, now) and canvas.waits:
        assert time.monotonic() < end, "the picture never came"
        time.sleep(0.002)
