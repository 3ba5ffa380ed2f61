"""The image of the scene as textures, drawn again only when its render request has changed.

Needs a GL context but no window. It is in one of three phases:

- "moving": the camera moved a moment ago. On a slow machine the image has fewer pixels, and of a large scene
  merged Gaussians.
- "settling": the camera rests and the image is not yet the one that is wanted. Where that takes long another
  thread rasterizes it, and merged Gaussians stand in.
- "still": the image is the one that is wanted. Nothing is done.
"""

import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from typing import Generic, Literal, TypeVar

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError
from langsplat_core.progress import Progress, watched
from langsplat_core.scene import Gaussians
from langsplat_core.scene.gaussians import Merged, merged
from langsplat_viewer.actions import editing, selecting, viewpoint
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.commands import with_key
from langsplat_viewer.jobs import Worker
from langsplat_viewer.rendering.renderer import GlRenderer, Rasterized, Rasterizing
from langsplat_viewer.rendering.request import (
    FULL,
    UNCLIPPED,
    Detail,
    RenderRequest,
    why_nothing,
    why_undrawable,
)
from langsplat_viewer.state import FrameStats, ViewerState

REST_SECONDS = 0.07  # without a move, after which the camera rests
KEPT_SIZES = 3  # of images: the full one and two coarse ones
NOTHING_LEFT = "all of the scene is hidden or deleted"
NOTHING_BETWEEN = "nothing of the scene in this picture lies between the cuts: move them in the panel Camera"

Phase = Literal["moving", "settling", "still"]
Key = tuple[int, int, int]  # which pane, width, height


class Canvas:
    """Keeps textures up to date with a `ViewerState`."""

    def __init__(
        self,
        ctx: moderngl.Context,
        renderer: GlRenderer,
        clock: Callable[[], float] = time.perf_counter,
        quick: GlRenderer | None = None,
    ) -> None:
        """`clock`, in seconds, times the drawing. `quick`: another renderer, which draws merged Gaussians
        while the camera moves, where images take long."""
        self._ctx, self._fine, self._quick, self._clock = ctx, renderer, quick, clock
        self._merger: Latest[Gaussians, Merged] = Latest(merged)
        self._background: Latest[Rasterizing, Rasterized] = Latest(
            lambda wanted, report: _rasterize(wanted, report, clock)
        )
        self._pace = Pace()
        self._targets: dict[Key, moderngl.Framebuffer] = {}  # the latest used last
        self._textures: dict[Key, moderngl.Texture] = {}
        self.phase: Phase = "still"
        self._view: OrbitCamera | None = None
        self._moving: object = None  # what a gizmo does
        self._moved = -1e9  # when the view last changed, seconds
        self._tried: RenderRequest | None = None  # the last one that was drawn, if only in vain
        self._shown: RenderRequest | None = None  # what the textures show
        self._timed = False  # the steps of drawing are measured
        self._unsure = False  # whether the image shows anything is not known yet
        # One for each pane; RGBA8, first row at the bottom, as GL has it.
        self.textures: tuple[moderngl.Texture, ...] = ()

    def update(self, state: ViewerState, now: float) -> bool:
        """Draw if anything changed since the last call; returns whether a finer image is still due.

        `now` in seconds. Raises what the renderer raises (BackendError, moderngl.Error); the same
        request is then not tried again.
        """
        if state.scene is None or state.view is None:
            self._background.drop()
            self.phase = "still"
            return False
        if state.view is not self._view or state.moving is not self._moving:
            self._moved = now if self._view is not None else self._moved
            self._view, self._moving = state.view, state.moving
        request = state.request().without_line()
        self._pace.expect(len(state.scene.gaussians))
        moving = now - self._moved < REST_SECONDS
        if self._begins_timing(state, moving):
            self._tried = None
            self._fine.forget()
        self.phase = "moving" if moving else self._at_rest(request)
        if self.phase == "settling" and self._pace.is_slow:
            self._settle(state, request)
        else:
            self._background.drop()
            if self.phase == "settling":
                self._draw(state, request)
            elif moving:
                self._follow(state, request)
        self.phase = "moving" if moving else self._at_rest(request)
        if self.phase == "still":
            self._explain_nothing(state)
        return self.phase != "still"

    def _at_rest(self, request: RenderRequest) -> Phase:
        return "still" if request == self._tried else "settling"

    @property
    def waits(self) -> bool:
        """True while another thread rasterizes the image; it calls what `wake_with` was given when it has."""
        return self._background.waits

    @property
    def is_running(self) -> bool:
        """True while other threads are at work, wanted or not."""
        return self._background.worker.is_running or self._merger.worker.is_running

    def wake_with(self, wake: Callable[[], None]) -> None:
        """Have `wake` called on another thread when `update` should be."""
        self._background.worker.wake = wake

    def _follow(self, state: ViewerState, request: RenderRequest) -> None:
        if not state.coarse_while_moving:
            if request != self._tried:
                self._draw(state, request)
        elif self._changes(request):
            level = self._pace.level(self._merged(request) is not None)
            self._draw(state, self._at(request, level))

    def _settle(self, state: ViewerState, request: RenderRequest) -> None:
        """Settling, slowly: draw the full image once another thread has rasterized it; until then one of
        merged Gaussians where they are there, else what was there stays."""
        rasterizing = self._fine.ahead(request)
        if rasterizing is None:
            self._background.drop()
            self._draw(state, request)
            return
        self._background.want(rasterizing)
        try:
            made = self._background.made(rasterizing)
        except BackendError:
            self._background.drop()
            self._tried = request
            raise
        if made is not None:
            self._background.drop()
            self._draw(state, request, made)
        elif self._changes(request) and state.coarse_while_moving and self._merged(request) is not None:
            level = self._pace.stand_in()
            if level is not None:
                self._draw(state, self._at(request, level))

    def _changes(self, request: RenderRequest) -> bool:
        """True where the image on screen is of another request, at any level of detail."""
        return self._tried is None or replace(self._tried, detail=FULL) != request

    def _merged(self, request: RenderRequest) -> Merged | None:
        if self._quick is not None:
            with suppress(BackendError):  # for want of memory: images stay as they are
                return self._merger.made(request.scene.scene.gaussians)
        return None

    def _at(self, request: RenderRequest, level: "Level") -> RenderRequest:
        fewer = self._merged(request) if level.merged else None
        return replace(request, detail=Detail(level.scale, fewer))

    def _renderer_of(self, request: RenderRequest) -> GlRenderer:
        return self._fine if request.detail.merged is None or self._quick is None else self._quick

    def _draw(self, state: ViewerState, request: RenderRequest, made: Rasterized | None = None) -> None:
        """`made`: by another thread, of the full image."""
        is_projected = self._tried is None or request.placement != self._tried.placement
        if self._quick is not None and (
            self._tried is None or request.scene.source is not self._tried.scene.source
        ):
            self._quick.forget()  # another scene
        self._tried = request  # also where it fails: it is not tried again
        camera, detail = request.drawn_camera, request.detail
        keys = [(place, camera.width, camera.height) for place in range(len(request.panes))]
        targets = [self._target(key, len(keys)) for key in keys]
        began = self._clock()
        with watched() if state.timing.wanted else nullcontext(dict[str, float]()) as laps:
            if made is not None:
                self._fine.take(made)
            self._renderer_of(request).draw(request, targets)
        self._ctx.finish()
        milliseconds = 1e3 * (self._clock() - began)
        if made is not None:
            milliseconds, laps = milliseconds + made.milliseconds, {**made.laps, **laps}
        if state.timing.wanted and detail == FULL:
            for name, taken in (*laps.items(), ("picture", milliseconds)):
                state.timing.add(name, taken)
        if is_projected:
            self._pace.drew(Level(detail.scale, detail.merged is not None), milliseconds)
        if self._quick is not None and self._pace.is_slow:
            self._merger.want(request.scene.scene.gaussians)
        self._shown = request
        self.textures = tuple(self._textures[key] for key in keys)
        size = (camera.width, camera.height)
        state.stats = FrameStats(milliseconds, *size, detail.scale, detail.merged is not None)
        state.nothing, self._unsure = "", True

    def _begins_timing(self, state: ViewerState, moving: bool) -> bool:
        """True for the first frame whose steps are measured: what was kept of earlier ones would have
        taken no time."""
        if state.timing.wanted and moving:
            return False  # once it rests
        before, self._timed = self._timed, state.timing.wanted
        return self._timed and not before

    def _explain_nothing(self, state: ViewerState) -> None:
        """Say why an image shows nothing; asked once, at rest, since it reads the image back."""
        if self._unsure and self._shown is not None:
            self._unsure = False
            if self._renderer_of(self._shown).shows_nothing():
                state.nothing = _why_nothing(self._shown)

    def _target(self, key: Key, count: int) -> moderngl.Framebuffer:
        """A framebuffer for one of `count` panes; those of the last few sizes are kept, because moving
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

    @property
    def backend(self) -> str:
        return self._fine.backend

    def close(self) -> None:
        self._background.worker.close()
        self._merger.worker.close()

    def release(self) -> None:
        """Give device memory back; the canvas cannot be used afterwards."""
        for target in self._targets.values():
            target.release()
        for texture in self._textures.values():
            texture.release()
        for renderer in (self._fine, self._quick):
            if renderer is not None:
                renderer.release()

    def point_at(self, u: float, v: float) -> Array | None:
        if self._shown is None:
            return None
        camera = self._shown.drawn_camera
        pixel = (self._shown.split.within_pane(u) * camera.width, v * camera.height)
        depth = self._renderer_of(self._shown).depth_at(self._shown, *pixel)
        return None if depth is None else camera.unproject(pixel, depth)

    def depths(self) -> Array | None:
        return None if self._shown is None else self._renderer_of(self._shown).depth_map(self._shown)

    def capture(self, request: RenderRequest) -> Array:
        return self._fine.read(request)


def _why_nothing(request: RenderRequest) -> str:
    gaussians = request.scene.scene.gaussians
    if len(request.scene.source.gaussians) and not len(gaussians):
        shown = with_key("show what is hidden", selecting.show_hidden)
        return f"{NOTHING_LEFT}: {shown}, or {with_key('undo', editing.undo)}"
    if request.clip != UNCLIPPED and gaussians.valid().any():
        return NOTHING_BETWEEN
    reason = why_nothing(gaussians, request.camera)
    elsewhere = not why_undrawable(gaussians)  # another view would show something
    back = with_key("return to the opening view", viewpoint.reset_view)
    return f"{reason}: {back}" if elsewhere else reason


# Level of detail while the camera moves, learned from the times of earlier images.

MOVING_BUDGET = 25.0  # milliseconds: with the panels, some thirty images a second
GUESS = 4e-4  # milliseconds of a full image for each Gaussian, before one was drawn
MERGED_SHARE = 0.25  # of an image's time, guessed, when four Gaussians are drawn as one
FORGET = 0.8  # what was learned is lowered by this with every full image, so that better is tried again


@dataclass(frozen=True)
class Level:
    """One level of detail."""

    scale: float = 1.0  # of the window's resolution
    merged: bool = False  # see `langsplat_core.scene.gaussians`

    @property
    def guess(self) -> float:
        """Time, as a share of a full image's."""
        return self.scale**2 * (MERGED_SHARE if self.merged else 1)


FINE = Level()
PLAIN = (FINE, Level(0.5), Level(0.25))
# Merged at half the resolution is nearer to the full image than all of it at a quarter, and cheaper.
WITH_MERGED = (FINE, Level(0.5), Level(0.5, merged=True), Level(0.25, merged=True))


class Pace:
    """Times of images by level of detail, in milliseconds."""

    def __init__(self) -> None:
        self._count = 1
        self._each = GUESS  # of a full image's time, for one Gaussian
        self._shares: dict[Level, float] = {}  # of the full image's time, measured

    def expect(self, count: int) -> None:
        self._count = max(count, 1)

    @property
    def is_slow(self) -> bool:
        """True where full images are too slow to follow a movement."""
        return not self._is_within(FINE)

    def drew(self, level: Level, milliseconds: float) -> None:
        if level == FINE:
            self._each = milliseconds / self._count
            self._shares = {other: FORGET * share for other, share in self._shares.items()}
        elif self._each > 0:
            self._shares[level] = (self._share(level) + milliseconds / (self._each * self._count)) / 2

    def level(self, has_merged: bool) -> Level:
        """The finest at which an image is expected within the budget, or the coarsest of all."""
        levels = WITH_MERGED if has_merged else PLAIN
        return next(filter(self._is_within, levels), levels[-1])

    def stand_in(self) -> Level | None:
        """The finest of merged Gaussians that is expected within the budget, if there is one: all of them are
        projected for few pixels, too."""
        merged = (level for level in WITH_MERGED if level.merged)
        return next(filter(self._is_within, merged), None)

    def _is_within(self, level: Level) -> bool:
        return self._each * self._count * self._share(level) <= MOVING_BUDGET

    def _share(self, level: Level) -> float:
        return 1.0 if level == FINE else self._shares.get(level, level.guess)


# Other threads: one rasterizes the full image of a large scene, one merges its Gaussians.


W = TypeVar("W")
M = TypeVar("M")


class Latest(Generic[W, M]):
    """Makes one thing at a time on a thread of its own: the one that is wanted now. Results of others are
    dropped."""

    def __init__(self, make: Callable[[W, Progress], M]) -> None:
        self.worker = Worker()
        self._make = make
        self._wanted: W | None = None
        self._made: M | None = None
        self._problem = ""

    @property
    def waits(self) -> bool:
        """True while something is wanted that has not been dropped."""
        return self._wanted is not None

    def want(self, wanted: W) -> None:
        """Begin to make the result for `wanted`, unless it is under way or there."""
        if wanted != self._wanted:
            self.drop()
            self._wanted = wanted
            make = self._make
            self.worker.submit("", lambda report: make(wanted, report), self._keep, self._fail)

    def made(self, wanted: W) -> M | None:
        """The result, if it is ready. Raises BackendError, once, where it failed."""
        self.worker.poll()
        problem, self._problem = self._problem, ""
        if problem:
            raise BackendError(problem)
        return self._made if wanted == self._wanted else None

    def drop(self) -> None:
        """Cancel the work under way, and drop its result."""
        self.worker.cancel()
        self.worker.poll()  # so that nothing of a job that was left is held
        self._wanted, self._made, self._problem = None, None, ""

    def _keep(self, made: M) -> None:
        self._made = made

    def _fail(self, problem: str) -> None:
        self._problem = problem


def _rasterize(wanted: Rasterizing, report: Progress, clock: Callable[[], float]) -> Rasterized:
    began = clock()
    with watched() as laps:
        finish = wanted.work(report)
    return Rasterized(wanted, finish, 1e3 * (clock() - began), laps)
