"""The pictures of the scene as textures, drawn again only when something it depends on has changed.

Needs a GL context but no window. While the camera moves on a slow machine the picture is drawn at a
fraction of the window's resolution; as soon as it rests, once more at full resolution.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Protocol

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges
from langsplat_core.scene import Camera, Scene
from langsplat_core.stopwatch import watched
from langsplat_viewer import actions, splitting
from langsplat_viewer.channels import Layers
from langsplat_viewer.commands import with_key
from langsplat_viewer.controls import OrbitCamera
from langsplat_viewer.keys import Changed
from langsplat_viewer.looking import drawn_scene, why_nothing, why_undrawable
from langsplat_viewer.marked_scene import MarkedScene, layers_of, marked_scene
from langsplat_viewer.seeing import UNCLIPPED, Clip, Splats
from langsplat_viewer.state import FrameStats, ViewerState

SCALES = (1.0, 0.5, 0.25)
MOVING_BUDGET = 80.0  # milliseconds per picture that still feel like motion
REST_SECONDS = 0.15  # without a move, after which the fine picture is drawn
NOTHING_LEFT = "all of the scene is hidden or deleted"
NOTHING_BETWEEN = "nothing of the scene in this picture lies between the cuts: move them in the panel Camera"


Key = tuple[int, int, int]  # which picture, width, height


class Renderer(Protocol):
    """What `frame.FrameRenderer` offers."""

    backend: str

    def set_scene(self, scene: Scene) -> None:
        """Draw this scene from now on."""

    def set_clip(self, clip: Clip) -> None:
        """Draw what lies between other depths from now on."""

    def set_layers(self, latent_rgb: Array | None, relevancies: Array | None) -> None:
        """(N, 3) latent colours and (N, Q) relevancies, Q <= 3, of the scene's Gaussians."""

    def prepare(self, camera: Camera, pictures: Sequence[tuple[PictureConfig, Layers | None]]) -> None:
        """Rasterize at once what several pictures of one camera need."""

    def draw(
        self,
        target: moderngl.Framebuffer,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
        layers: Layers | None = None,
    ) -> None:
        """Draw into `target`, which has the camera's size; with `layers` in place of those that are set."""

    def read(
        self,
        camera: Camera,
        picture: PictureConfig,
        heat_ranges: HeatRanges = (),
        layers: Layers | None = None,
    ) -> Array:
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
        self._targets: dict[Key, moderngl.Framebuffer] = {}  # the latest used last
        self._textures: dict[Key, moderngl.Texture] = {}
        self._state: ViewerState | None = None  # that was last shown
        self._scene: tuple[Scene, Splats] | None = None  # what the renderer has
        self._clip = UNCLIPPED  # what the renderer has
        self._marked: MarkedScene | None = None  # whose it is
        self._layers: list[tuple[tuple[object, ...], Layers | None]] = []  # of each picture, with their key
        self._drawn: tuple[object, ...] | None = None  # what the texture shows
        self._view: OrbitCamera | None = None
        self._moved = -1e9  # when the view last changed, seconds
        self._fine_ms = 0.0
        self._camera: Camera | None = None
        self._unsure = False  # whether the picture shows anything is not known yet
        # Of `splitting.pictures`; RGBA8, first row at the bottom, as GL has it.
        self.textures: tuple[moderngl.Texture, ...] = ()

    def update(self, state: ViewerState, now: float) -> bool:
        """Draw if anything changed since the last call; returns whether a finer picture is still due.

        `now` in seconds. Raises what the renderer raises (BackendError, moderngl.Error); the same
        picture is then not tried again.
        """
        self._state = state
        if state.scene is None or state.view is None:
            return False
        if state.view is not self._view:
            if self._view is not None:
                self._moved = now
            self._view = state.view
        moving = now - self._moved < REST_SECONDS
        scale = self._scale() if moving and state.coarse_while_moving else 1.0
        shown = splitting.pictures(state)
        looks = tuple((one.layers_key(), one.shown_picture(), one.heat_ranges()) for one in shown)
        key = (
            looks,
            state.seeing.splats,
            state.seeing.clip,
            state.view,
            splitting.picture_size(state),
            scale,
        )
        if key != self._drawn:
            self._drawn = key
            self._draw(state, shown, scale)
            state.nothing, self._unsure = "", True
        if self._unsure and not moving and self._camera is not None:
            self._unsure = False  # asked at rest only: it reads the picture back
            if self._renderer.shows_nothing():
                state.nothing = self._why_nothing(state.scene, self._camera, state.preferences.keys)
        return moving

    def _why_nothing(self, source: Scene, camera: Camera, keys: Changed) -> str:
        gaussians = source.gaussians if self._marked is None else self._marked.scene.gaussians
        if len(source.gaussians) and not len(gaussians):
            shown = with_key("show what is hidden", actions.show_hidden, keys)
            return f"{NOTHING_LEFT}: {shown}, or {with_key('undo', actions.undo, keys)}"
        if self._clip != UNCLIPPED and gaussians.valid().any():
            return NOTHING_BETWEEN
        reason = why_nothing(gaussians, camera)
        elsewhere = not why_undrawable(gaussians)  # another view would show something
        back = with_key("return to the opening view", actions.reset_view, keys)
        return f"{reason}: {back}" if elsewhere else reason

    def _scale(self) -> float:
        """The largest scale at which a picture is expected within the budget."""
        within = [s for s in SCALES if self._fine_ms * s * s <= MOVING_BUDGET]
        return within[0] if within else SCALES[-1]

    def _sync(self, shown: Sequence[ViewerState]) -> None:
        """Hand the scene and the layers of the first picture to the renderer if they are not the ones it has;
        keep those of the others, whose arrays stay the same objects while nothing changes."""
        source, first = shown[0].scene, shown[0]
        assert source is not None
        marked = self._marked = marked_scene(source, first.selection.marks, self._marked)
        splats = first.seeing.splats
        if self._scene is None or self._scene[0] is not marked.scene or self._scene[1] != splats:
            self._scene, self._layers = (marked.scene, splats), []
            self._renderer.set_scene(drawn_scene(marked.scene, splats))
        if first.seeing.clip != self._clip:
            self._clip = first.seeing.clip
            self._renderer.set_clip(self._clip)
        if not self._layers or self._layers[0][0] != first.layers_key():
            self._layers[:1] = [(first.layers_key(), None)]
            layers = layers_of(first, marked)
            self._renderer.set_layers(layers.latent_rgb, layers.relevancies)
        del self._layers[len(shown) :]
        for place, one in enumerate(shown[1:], 1):
            if len(self._layers) == place or self._layers[place][0] != one.layers_key():
                self._layers[place : place + 1] = [(one.layers_key(), layers_of(one, marked))]

    def _prepare(self, shown: Sequence[ViewerState], camera: Camera) -> list[Layers | None]:
        """Have the renderer ready to draw all pictures; returns the layers of each."""
        self._sync(shown)
        layers = [layers for _, layers in self._layers]
        if len(shown) > 1:
            looks = [one.shown_picture() for one in shown]
            self._renderer.prepare(camera, list(zip(looks, layers, strict=True)))
        return layers

    def _draw(self, state: ViewerState, shown: Sequence[ViewerState], scale: float) -> None:
        assert state.view is not None
        width, height = (max(1, round(side * scale)) for side in splitting.picture_size(state))
        camera = state.view.camera(width, height)
        keys = [(place, width, height) for place in range(len(shown))]
        targets = [self._target(key, len(shown)) for key in keys]
        began = self._clock()
        with watched() if state.timing.wanted else nullcontext(dict[str, float]()) as laps:
            for target, one, layers in zip(targets, shown, self._prepare(shown, camera), strict=True):
                self._renderer.draw(target, camera, one.shown_picture(), one.heat_ranges(), layers)
        self._ctx.finish()
        milliseconds = 1e3 * (self._clock() - began)
        if state.timing.wanted and scale == 1:
            for name, taken in (*laps.items(), ("picture", milliseconds)):
                state.timing.add(name, taken)
        if scale == 1:
            self._fine_ms = milliseconds
        self._camera = camera
        self.textures = tuple(self._textures[key] for key in keys)
        state.stats = FrameStats(milliseconds, width, height, scale)

    def _target(self, key: Key, count: int) -> moderngl.Framebuffer:
        """A framebuffer for one of `count` pictures; those of the last few sizes are kept, because moving
        alternates between two."""
        if key not in self._targets:
            while len(self._targets) >= len(SCALES) * count:
                oldest = next(iter(self._targets))
                self._targets.pop(oldest).release()
                self._textures.pop(oldest).release()
            texture = self._ctx.texture(key[1:], 4)
            texture.repeat_x = texture.repeat_y = False
            self._textures[key] = texture
            self._targets[key] = self._ctx.framebuffer([texture])
        self._targets[key] = self._targets.pop(key)
        return self._targets[key]

    def point_at(self, u: float, v: float) -> Array | None:
        """See `viewer.Surface`."""
        if self._camera is None or self._state is None:
            return None
        u = splitting.within_picture(self._state.seeing.split, u)
        pixel = (u * self._camera.width, v * self._camera.height)
        depth = self._renderer.depth_at(*pixel)
        return None if depth is None or depth <= 0 else self._camera.unproject(pixel, depth)

    def depths(self) -> Array | None:
        """See `viewer.Surface`."""
        return None if self._camera is None else self._renderer.depth_map()

    def capture(self, state: ViewerState) -> Array:
        """See `viewer.Surface`."""
        assert state.view is not None
        shown = splitting.pictures(state)
        if state is not self._state:  # of another size: what is on screen is drawn again
            self._drawn = None
        self._camera = camera = state.view.camera(*splitting.picture_size(state))
        images = [
            np.asarray(self._renderer.read(camera, one.shown_picture(), one.heat_ranges(), layers))
            for one, layers in zip(shown, self._prepare(shown, camera), strict=True)
        ]
        return splitting.joined(state.seeing.split, images)
