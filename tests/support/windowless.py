"""A viewer without a window: a fake picture, fake files, and frames on demand."""

import time
from pathlib import Path

import numpy as np

from langsplat_core.errors import FormatError
from langsplat_core.scene import Scene
from langsplat_viewer.actions import viewpoint
from langsplat_viewer.canvas import Canvas
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

    def capture(self, state: ViewerState):
        return np.full((6, 8, 3), 77, np.uint8)


class FakeRenderer:
    """Notes what is asked of it, and takes as long as it is told to, on a clock of its own."""

    backend = "fake"

    def __init__(self, seconds: float = 0.0) -> None:
        self.calls: list[tuple[str, object]] = []
        self.seconds = seconds  # that a picture takes
        self.now = 0.0

    def clock(self) -> float:
        return self.now

    def set_scene(self, scene) -> None:
        self.calls.append(("scene", scene))

    def set_clip(self, clip) -> None:
        self.calls.append(("clip", clip))

    def forget(self) -> None:
        self.calls.append(("forget", None))

    def set_layers(self, latent_rgb, relevancies) -> None:
        self.calls.append(("layers", latent_rgb is not None))

    def prepare(self, camera, pictures) -> None:
        self.calls.append(("prepare", [picture.display for picture, _ in pictures]))

    def ahead(self, camera, pictures) -> None:
        return None

    def draw(self, target, camera, picture, heat_ranges=(), layers=None) -> None:
        self.calls.append(("draw", (camera.width, camera.height)))
        self.now += self.seconds
        target.clear(1.0, 0.0, 0.0, 1.0)

    def read(self, camera, picture, heat_ranges=(), layers=None):
        return np.zeros((camera.height, camera.width, 3), np.uint8)

    def shows_nothing(self) -> bool:
        return False

    def depth_at(self, x_px, y_px):
        return 2.0 if x_px > 100 else None


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


def arrive(viewer: Viewer) -> None:
    """Let a gliding camera arrive."""
    viewpoint.tick(viewer, viewer.clock + 2 * GLIDE_SECONDS)


def errors(viewer: Viewer) -> list[str]:
    return [message.text for message in viewer.state.messages if message.is_error]


def rest(canvas: Canvas, state: ViewerState, now: float) -> None:
    """Update until the fine picture is there, whoever rasterizes it."""
    end = time.monotonic() + 60
    while canvas.update(state, now) and canvas.waits:
        assert time.monotonic() < end, "the picture never came"
        time.sleep(0.002)
