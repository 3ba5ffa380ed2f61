"""The picture of the scene as a texture, drawn again only when something it depends on has changed.

Needs a GL context but no window. While the camera moves on a slow machine the picture is drawn at a
fraction of the window's resolution; as soon as it rests, once more at full resolution.
"""

import time
from collections.abc import Callable
from typing import Protocol

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.controls import OrbitCamera
from langsplat_viewer.looking import why_nothing, why_undrawable
from langsplat_viewer.marked_scene import MarkedScene, marked_scene
from langsplat_viewer.state import FrameStats, ViewerState

SCALES = (1.0, 0.5, 0.25)
MOVING_BUDGET = 80.0  # milliseconds per picture that still feel like motion
REST_SECONDS = 0.15  # without a move, after which the fine picture is drawn
NOTHING_LEFT = "all of the scene is hidden or deleted: U shows what is hidden, Ctrl+Z undoes"


class Renderer(Protocol):
    """What `frame.FrameRenderer` offers."""

    backend: str

    def set_scene(self, scene: Scene) -> None:
        """Draw this scene from now on."""

    def set_layers(self, latent_rgb: Array | None, relevancies: Array | None) -> None:
        """(N, 3) latent colours and (N, Q) relevancies, Q <= 3, of the scene's Gaussians."""

    def draw(
        self,
        target: moderngl.Framebuffer,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
    ) -> None:
        """Draw into `target`, which has the camera's size."""

    def read(self, camera: Camera, picture: PictureConfig, heat_ranges: HeatRanges = ()) -> Array:
        """(H, W, 3) uint8 picture."""

    def shows_nothing(self) -> bool:
        """Whether the last picture holds nothing of the scene."""

    def depth_at(self, x_px: float, y_px: float) -> float | None:
        """Camera z of the surface at a pixel of the last picture, world units."""

    def depth_map(self) -> Array | None:
        """(H, W) the same at every pixel, 0 where there is none; None before the first picture."""


class Canvas:
    """Keeps a texture up to date with a `ViewerState`."""

    def __init__(
        self, ctx: moderngl.Context, renderer: Renderer, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        """`clock`, in seconds, times the drawing."""
        self._ctx = ctx
        self._renderer = renderer
        self._clock = clock
        self._targets: dict[tuple[int, int], moderngl.Framebuffer] = {}  # by size, the latest used last
        self._textures: dict[tuple[int, int], moderngl.Texture] = {}
        self._scene: Scene | None = None  # that the renderer has
        self._marked: MarkedScene | None = None  # whose it is
        self._layers: tuple[object, ...] | None = None
        self._drawn: tuple[object, ...] | None = None  # what the texture shows
        self._view: OrbitCamera | None = None
        self._moved = -1e9  # when the view last changed, seconds
        self._fine_ms = 0.0
        self._camera: Camera | None = None
        self._unsure = False  # whether the picture shows anything is not known yet
        self.texture: moderngl.Texture | None = None  # RGBA8, first row at the bottom, as GL has it

    def update(self, state: ViewerState, now: float) -> bool:
        """Draw if anything changed since the last call; returns whether a finer picture is still due.

        `now` in seconds. Raises what the renderer raises (BackendError, moderngl.Error); the same
        picture is then not tried again.
        """
        if state.scene is None or state.view is None:
            return False
        if state.view is not self._view:
            if self._view is not None:
                self._moved = now
            self._view = state.view
        moving = now - self._moved < REST_SECONDS
        scale = self._scale() if moving and state.coarse_while_moving else 1.0
        size = (max(1, round(state.size[0] * scale)), max(1, round(state.size[1] * scale)))
        picture = state.shown_picture()
        key = (state.layers_key(), picture, state.view, state.size, scale, state.heat_ranges())
        if key != self._drawn:
            self._drawn = key
            self._draw(state, size, scale)
            state.nothing, self._unsure = "", True
        if self._unsure and not moving and self._camera is not None:
            self._unsure = False  # asked at rest only: it reads the picture back
            if self._renderer.shows_nothing():
                state.nothing = self._why_nothing(state.scene, self._camera)
        return moving

    def _why_nothing(self, source: Scene, camera: Camera) -> str:
        gaussians = source.gaussians if self._scene is None else self._scene.gaussians
        if len(source.gaussians) and not len(gaussians):
            return NOTHING_LEFT
        reason = why_nothing(gaussians, camera)
        elsewhere = not why_undrawable(gaussians)  # another view would show something
        return f"{reason}: press R for the opening view" if elsewhere else reason

    def _scale(self) -> float:
        """The largest scale at which a picture is expected within the budget."""
        within = [s for s in SCALES if self._fine_ms * s * s <= MOVING_BUDGET]
        return within[0] if within else SCALES[-1]

    def _sync(self, state: ViewerState) -> None:
        """Hand the scene and the layers to the renderer if they are not the ones it has."""
        assert state.scene is not None
        marked = self._marked = marked_scene(state.scene, state.selection.marks, self._marked)
        if marked.scene is not self._scene:
            self._scene = marked.scene
            self._renderer.set_scene(marked.scene)
            self._layers = None
        if state.layers_key() != self._layers:
            self._layers = state.layers_key()
            latent = marked.layer(state.latent_rgb(), is_colour=True)
            self._renderer.set_layers(latent, marked.layer(state.relevancies()))

    def _draw(self, state: ViewerState, size: tuple[int, int], scale: float) -> None:
        assert state.view is not None
        self._sync(state)
        target = self._target(size)
        camera = state.view.camera(*size)
        began = self._clock()
        self._renderer.draw(target, camera, state.shown_picture(), state.heat_ranges())
        self._ctx.finish()
        milliseconds = 1e3 * (self._clock() - began)
        if scale == 1:
            self._fine_ms = milliseconds
        self._camera = camera
        self.texture = self._textures[size]
        state.stats = FrameStats(milliseconds, *size, scale)

    def _target(self, size: tuple[int, int]) -> moderngl.Framebuffer:
        """A framebuffer of this size; the last few sizes are kept, because moving alternates between two."""
        if size not in self._targets:
            if len(self._targets) >= len(SCALES):
                oldest = next(iter(self._targets))
                self._targets.pop(oldest).release()
                self._textures.pop(oldest).release()
            texture = self._ctx.texture(size, 4)
            texture.repeat_x = texture.repeat_y = False
            self._textures[size] = texture
            self._targets[size] = self._ctx.framebuffer([texture])
        self._targets[size] = self._targets.pop(size)
        return self._targets[size]

    def point_at(self, u: float, v: float) -> Array | None:
        """See `viewer.Surface`."""
        if self._camera is None:
            return None
        pixel = (u * self._camera.width, v * self._camera.height)
        depth = self._renderer.depth_at(*pixel)
        return None if depth is None or depth <= 0 else self._camera.unproject(pixel, depth)

    def depths(self) -> Array | None:
        """See `viewer.Surface`."""
        return None if self._camera is None else self._renderer.depth_map()

    def capture(self, state: ViewerState) -> Array:
        """See `viewer.Surface`."""
        assert state.view is not None
        self._sync(state)
        self._camera = state.view.camera(*state.size)
        return np.asarray(self._renderer.read(self._camera, state.shown_picture(), state.heat_ranges()))
