"""The pictures of the scene as textures, drawn again only when something it depends on has changed.

Needs a GL context but no window. While the camera moves on a slow machine the picture is drawn at a
fraction of the window's resolution, of a large scene from merged Gaussians; as soon as it rests, once more
with everything, which another thread rasterizes where that takes long.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError
from langsplat_core.progress import watched
from langsplat_core.scene import Camera
from langsplat_core.scene.gaussians import Merged
from langsplat_viewer import staging
from langsplat_viewer.actions import selecting, undoing, viewpoint
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.commands import with_key
from langsplat_viewer.drawing.channels import UNCLIPPED, Layers, why_nothing, why_undrawable
from langsplat_viewer.drawing.renderer import FINE, Level, Pace, Rasterized, Renderer
from langsplat_viewer.staging import (
    Background,
    Depiction,
    MarkedScene,
    Merger,
    Stage,
    depiction,
    marked_scene,
)
from langsplat_viewer.state import FrameStats, ViewerState

REST_SECONDS = 0.1  # without a move, after which the fine picture is drawn
KEPT_SIZES = 3  # of pictures: the fine one and two coarse ones
NOTHING_LEFT = "all of the scene is hidden or deleted"
NOTHING_BETWEEN = "nothing of the scene in this picture lies between the cuts: move them in the panel Camera"


Key = tuple[int, int, int]  # which picture, width, height


class Canvas:
    """Keeps a texture up to date with a `ViewerState`."""

    def __init__(
        self,
        ctx: moderngl.Context,
        renderer: Renderer,
        clock: Callable[[], float] = time.perf_counter,
        quick: Renderer | None = None,
    ) -> None:
        """`clock`, in seconds, times the drawing. `quick`: another renderer, which draws merged Gaussians
        while the camera moves, where pictures take long."""
        self._ctx = ctx
        self._fine = Stage(renderer)
        self._quick = None if quick is None else Stage(quick)
        self._renderer = renderer  # that drew the last picture
        self._merger = Merger()
        self._background = Background(clock)
        self._pace = Pace()
        self._clock = clock
        self._targets: dict[Key, moderngl.Framebuffer] = {}  # the latest used last
        self._textures: dict[Key, moderngl.Texture] = {}
        self._state: ViewerState | None = None  # that was last shown
        self._marked: MarkedScene | None = None  # what is drawn
        self._drawn: Depiction | None = None  # what the textures show
        self._drawn_at = FINE
        self._view: OrbitCamera | None = None
        self._moved = -1e9  # when the view last changed, seconds
        self._camera: Camera | None = None
        self._timed = False  # the steps of the pictures are measured
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
            self._background.drop()
            return False
        if state.view is not self._view:
            if self._view is not None:
                self._moved = now
            self._view = state.view
        moving = now - self._moved < REST_SECONDS
        coarse = moving and state.coarse_while_moving
        shown = staging.shown_pictures(state)
        wanted = depiction(state, shown)
        if self._begins_timing(state, moving):
            self._drawn = None
            self._fine.renderer.forget()
        self._pace.expect(len(state.scene.gaussians))
        is_due = wanted != self._drawn or (self._drawn_at != FINE and not coarse)
        if is_due and not moving and self._pace.is_slow:
            self._draw_at_rest(state, shown, wanted)
        else:
            self._background.drop()
            if is_due:
                level = self._pace.level(self._merged() is not None) if coarse else FINE
                self._draw(state, shown, wanted, level)
        if self._unsure and not moving and not self.waits and self._camera is not None:
            self._unsure = False  # asked at rest only: it reads the picture back
            if self._renderer.shows_nothing():
                state.nothing = self._why_nothing(wanted, self._camera)
        return moving or self.waits

    @property
    def waits(self) -> bool:
        """Whether another thread rasterizes the picture; it calls what `wake_with` was given when it has."""
        return self._background.waits

    @property
    def is_running(self) -> bool:
        """Whether other threads are at work, wanted or not."""
        return self._background.worker.is_running or self._merger.is_running

    def wake_with(self, wake: Callable[[], None]) -> None:
        """Have `wake` called on another thread when `update` should be."""
        self._background.worker.wake = wake

    def _draw_at_rest(self, state: ViewerState, shown: Sequence[ViewerState], wanted: Depiction) -> None:
        """Draw the fine picture once another thread has rasterized it; until then one of merged
        Gaussians where they are there, else what was there stays."""
        camera = wanted.view.camera(*wanted.size)
        rasterizing = self._fine.ahead(wanted, shown, self._mark(wanted), camera)
        if rasterizing is None:
            self._background.drop()
            self._draw(state, shown, wanted, FINE)
            return
        try:
            made = self._background.get(rasterizing)
        except BackendError:
            self._drawn, self._drawn_at = wanted, FINE
            raise
        if made is not None:
            self._draw(state, shown, wanted, FINE, made)
        elif wanted != self._drawn and state.coarse_while_moving and self._merged() is not None:
            level = self._pace.stand_in()
            if level is not None:
                self._draw(state, shown, wanted, level)

    def _begins_timing(self, state: ViewerState, moving: bool) -> bool:
        """Whether this is the first frame whose steps are measured: what was kept of earlier ones would have
        taken no time."""
        if state.timing.wanted and moving:
            return False  # once it rests
        before, self._timed = self._timed, state.timing.wanted
        return self._timed and not before

    def _why_nothing(self, wanted: Depiction, camera: Camera) -> str:
        source = wanted.model.scene
        gaussians = source.gaussians if self._marked is None else self._marked.scene.gaussians
        if len(source.gaussians) and not len(gaussians):
            shown = with_key("show what is hidden", selecting.show_hidden)
            return f"{NOTHING_LEFT}: {shown}, or {with_key('undo', undoing.undo)}"
        if wanted.clip != UNCLIPPED and gaussians.valid().any():
            return NOTHING_BETWEEN
        reason = why_nothing(gaussians, camera)
        elsewhere = not why_undrawable(gaussians)  # another view would show something
        back = with_key("return to the opening view", viewpoint.reset_view)
        return f"{reason}: {back}" if elsewhere else reason

    def _merged(self) -> Merged | None:
        """What the quick renderer can draw, if it is there."""
        if self._quick is None or self._marked is None:
            return None
        return self._merger.made_of(self._marked.scene.gaussians)

    def _prepare(
        self, wanted: Depiction, shown: Sequence[ViewerState], camera: Camera, level: Level
    ) -> list[Layers | None]:
        """Choose the renderer and have it ready to draw all pictures; returns the layers of each."""
        marked = self._mark(wanted)
        instead = self._merged() if level.merged else None
        stage = self._fine if instead is None or self._quick is None else self._quick
        self._renderer = stage.renderer
        if self._quick is not None:
            self._quick.let_go(wanted.model.scene)
        return stage.prepare(wanted, shown, marked, camera, instead)

    def _mark(self, wanted: Depiction) -> MarkedScene:
        """What is drawn of the scene."""
        self._marked = marked_scene(wanted.model.scene, wanted.model.marks, self._marked)
        return self._marked

    def _draw(
        self,
        state: ViewerState,
        shown: Sequence[ViewerState],
        wanted: Depiction,
        level: Level,
        made: Rasterized | None = None,
    ) -> None:
        """`made`: by another thread, of the fine picture."""
        is_projected = level != self._drawn_at or self._drawn is None or not wanted.is_placed_as(self._drawn)
        self._drawn, self._drawn_at = wanted, level  # also where it fails: it is not tried again
        width, height = (max(1, round(side * level.scale)) for side in wanted.size)
        camera = wanted.view.camera(width, height)
        keys = [(place, width, height) for place in range(len(shown))]
        targets = [self._target(key, len(shown)) for key in keys]
        began = self._clock()
        with watched() if state.timing.wanted else nullcontext(dict[str, float]()) as laps:
            if made is not None:
                self._fine.renderer.take(made)
            prepared = self._prepare(wanted, shown, camera, level)
            for target, look, layers in zip(targets, wanted.looks, prepared, strict=True):
                self._renderer.draw(target, camera, look.picture, look.heat_ranges, layers)
        self._ctx.finish()
        milliseconds = 1e3 * (self._clock() - began)
        if made is not None:
            milliseconds, laps = milliseconds + made.milliseconds, {**made.laps, **laps}
        if state.timing.wanted and level == FINE:
            for name, taken in (*laps.items(), ("picture", milliseconds)):
                state.timing.add(name, taken)
        if is_projected:
            self._pace.drew(level, milliseconds)
        if self._quick is not None and self._marked is not None and self._pace.is_slow:
            self._merger.want(self._marked.scene.gaussians)
        self._camera = camera
        self.textures = tuple(self._textures[key] for key in keys)
        state.stats = FrameStats(milliseconds, width, height, level.scale, level.merged)
        state.nothing, self._unsure = "", True

    def _target(self, key: Key, count: int) -> moderngl.Framebuffer:
        """A framebuffer for one of `count` pictures; those of the last few sizes are kept, because moving
        alternates between two."""
        if key not in self._targets:
            while len(self._targets) >= KEPT_SIZES * count:
                oldest = next(iter(self._targets))
                self._targets.pop(oldest).release()
                self._textures.pop(oldest).release()
            texture = self._ctx.texture(key[1:], 4)
            texture.repeat_x = texture.repeat_y = False
            self._textures[key] = texture
            self._targets[key] = self._ctx.framebuffer([texture])
        self._targets[key] = self._targets.pop(key)
        return self._targets[key]

    def close(self) -> None:
        """The window closes."""
        self._background.worker.close()
        self._merger.close()

    def point_at(self, u: float, v: float) -> Array | None:
        """See `viewer.Surface`."""
        if self._camera is None or self._state is None:
            return None
        u = staging.within_picture(self._state.seeing.split, u)
        pixel = (u * self._camera.width, v * self._camera.height)
        depth = self._renderer.depth_at(*pixel)
        return None if depth is None or depth <= 0 else self._camera.unproject(pixel, depth)

    def depths(self) -> Array | None:
        """See `viewer.Surface`."""
        return None if self._camera is None else self._renderer.depth_map()

    def capture(self, state: ViewerState) -> Array:
        """See `viewer.Surface`."""
        shown = staging.shown_pictures(state)
        wanted = depiction(state, shown)
        if state is not self._state:  # of another size: what is on screen is drawn again
            self._drawn = None
        self._camera = camera = wanted.view.camera(*wanted.size)
        prepared = self._prepare(wanted, shown, camera, FINE)
        images = [
            np.asarray(self._renderer.read(camera, look.picture, look.heat_ranges, layers))
            for look, layers in zip(wanted.looks, prepared, strict=True)
        ]
        return staging.joined(state.seeing.split, images)
