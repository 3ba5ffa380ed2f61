"""The image of the scene as textures, drawn again only when its render request has changed.

The canvas needs a GL context but no window. It is in one of three phases:

- "moving": the camera moved a moment ago. On a slow machine the image has fewer pixels, and of a large scene
  merged Gaussians.
- "settling": the camera rests and the image is not yet the one that is wanted. Where that takes long another
  thread rasterizes it, and merged Gaussians stand in.
- "still": the image is the one that is wanted. Nothing is done.
"""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, Literal, TypeVar

import moderngl
from PIL import Image, ImageOps

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError
from langsplat_core.progress import Progress
from langsplat_core.scene.gaussians import Merged, merged
from langsplat_viewer.actions import editing, viewpoint
from langsplat_viewer.commands import with_key
from langsplat_viewer.jobs import Worker
from langsplat_viewer.rendering.renderer import Layers, Renderer
from langsplat_viewer.rendering.request import UNCLIPPED, RenderRequest, why_nothing, why_undrawable
from langsplat_viewer.state import FrameStats, ViewerState

REST_SECONDS = 0.07  # without a move, after which the camera counts as resting
MOVING_BUDGET = 25.0  # milliseconds of an image: with the panels, some thirty a second
THUMBNAIL = (480, 300)  # pixels
KEPT_SIZES = 3  # of images: the full one and two coarse ones


@dataclass(frozen=True)
class Detail:
    """Level of detail of an image."""

    scale: float = 1.0  # of the sides of the window's image
    merged: bool = False  # drawn from fewer, merged Gaussians, see `langsplat_core.scene.gaussians`


FULL = Detail()
PLAIN = (FULL, Detail(0.5), Detail(0.25))
# Merged at half the resolution is nearer to the full image than all of it at a quarter, and cheaper.
WITH_MERGED = (FULL, Detail(0.5), Detail(0.5, merged=True), Detail(0.25, merged=True))


class Canvas:
    """Keeps textures up to date with a `ViewerState`."""

    def __init__(
        self,
        ctx: moderngl.Context,
        renderer: Renderer[Any],
        clock: Callable[[], float] = time.perf_counter,
        budget: float = MOVING_BUDGET,
    ) -> None:
        """`clock`, in seconds, times the images; `budget`: milliseconds that one may take while it moves."""
        self._ctx, self._renderer, self._clock = ctx, renderer, clock
        self.backend = renderer.backend
        self._merger: Latest[Merged] = Latest()
        self._background: Latest[tuple[Layers[Any], float]] = Latest()  # and the milliseconds it took
        self._resolution = AdaptiveResolution(budget)
        self._kept: dict[tuple[int, int, int], moderngl.Texture] = {}  # by pane, width, height
        self.phase: Literal["moving", "settling", "still"] = "still"
        self._pose: tuple[object, object] | None = None  # the view, and what a gizmo does
        self._moved = -1e9  # when that last changed, seconds
        self._wanted: tuple[RenderRequest, Detail] | None = None  # what was drawn last, or failed to be
        self._drawn: RenderRequest | None = None  # the same at its level of detail
        self._unsure = False  # whether the image shows anything is not known yet
        # One for each pane; RGBA8, first row at the bottom, as GL has it.
        self.textures: tuple[moderngl.Texture, ...] = ()

    def update(self, state: ViewerState, now: float) -> bool:
        """Draw if anything changed since the last call; return whether a finer image is still due.

        `now` in seconds. Raises what the renderer raises (BackendError, moderngl.Error); the same
        request is then not tried again.
        """
        if state.open is None:
            self._background.drop()
            self.phase = "still"
            return False
        pose = state.open.view, state.moving
        if pose != self._pose:
            if self._pose is not None:  # the first view is no move
                self._moved = now
            self._pose = pose
        moving = now - self._moved < REST_SECONDS
        request = state.request().without_line()
        self._resolution.count = max(state.count, 1)
        if moving:
            self._background.drop()
            self._follow(state, request)
        elif self._wanted != (request, FULL):
            self._settle(state, request)
        is_full = self._wanted == (request, FULL)
        self.phase = "moving" if moving else "still" if is_full else "settling"
        if self.phase == "still":
            self._background.drop()
            if self._unsure and self._drawn is not None:  # tested once: the test reads the image back
                self._unsure = False
                state.nothing = _why_nothing(self._drawn) if self._renderer.shows_nothing() else ""
        return self.phase != "still"

    def _follow(self, state: ViewerState, request: RenderRequest) -> None:
        """Draw the image of a moving camera, at the finest level of detail within the budget."""
        if not state.preferences.coarse_while_moving:
            if self._wanted != (request, FULL):
                self._draw(state, request)
        elif self._changes(request):
            fewer = self._merged(request)
            detail = self._resolution.finest(PLAIN if fewer is None else WITH_MERGED)
            self._draw(state, request, detail, fewer)

    def _settle(self, state: ViewerState, request: RenderRequest) -> None:
        """Draw the full image of a camera that rests.

        Where that takes long it is drawn once another thread has rasterized it; until then merged Gaussians
        stand in where they are there, else the image before stays.
        """
        ahead = self._renderer.ahead(request) if self._resolution.is_slow else None
        if ahead is None:
            self._background.drop()
            self._draw(state, request)
            return
        key, work = ahead
        self._background.want(key, lambda report: self._timed(work, report))
        try:
            made = self._background.made(key)
        except BackendError:
            self._background.drop()
            self._wanted = request, FULL
            raise
        if made is not None:
            self._background.drop()
            self._renderer.take(made[0])
            self._draw(state, request, earlier=made[1])
        elif state.preferences.coarse_while_moving and self._changes(request):
            fewer = self._merged(request)
            detail = self._resolution.finest(WITH_MERGED[2:])
            if fewer is not None and self._resolution.is_quick(detail):
                self._draw(state, request, detail, fewer)

    def _timed(self, work: Callable[[Progress], Layers[Any]], report: Progress) -> tuple[Layers[Any], float]:
        began = self._clock()
        layers = work(report)
        return layers, 1e3 * (self._clock() - began)

    def _changes(self, request: RenderRequest) -> bool:
        return self._wanted is None or self._wanted[0] != request

    def _merged(self, request: RenderRequest) -> Merged | None:
        with suppress(BackendError):  # for want of memory: images stay as they are
            return self._merger.made(request.gaussians)
        return None

    def _draw(
        self,
        state: ViewerState,
        request: RenderRequest,
        detail: Detail = FULL,
        fewer: Merged | None = None,
        earlier: float = 0.0,
    ) -> None:
        """Draw an image and show it; `earlier`: milliseconds that its layers took on another thread."""
        drawn = request.reduced(detail.scale, fewer if detail.merged else None)
        before = self._drawn
        if before is not None and before.scene.source is not request.scene.source:
            self._merger.drop()  # of another scene
        self._wanted, self._drawn = (request, detail), drawn  # also if it fails: then it is not tried again
        size = drawn.camera.width, drawn.camera.height
        textures = self._targets(*size, len(drawn.panes))
        began = self._clock()
        self._renderer.draw(drawn, textures)
        self._ctx.finish()
        taken = 1e3 * (self._clock() - began) + earlier
        if before is None or drawn.projection != before.projection:
            self._resolution.drew(detail, taken)
        if self.backend == "cpu" and self._resolution.is_slow:  # a device draws them as they are
            gaussians = request.gaussians
            self._merger.want(gaussians, lambda report: merged(gaussians, report))
        self.textures = textures
        state.stats = FrameStats(taken, *size, detail.scale, detail.merged, drawn.depths)
        state.nothing, self._unsure = "", True

    def _targets(self, width: int, height: int, panes: int) -> tuple[moderngl.Texture, ...]:
        """Return one for each pane; those of the last few sizes are kept: moving alternates between two."""
        found = {(pane, width, height): self._kept.pop((pane, width, height), None) for pane in range(panes)}
        while len(self._kept) > (KEPT_SIZES - 1) * panes:
            self._kept.pop(next(iter(self._kept))).release()
        for key, texture in found.items():
            if texture is None:
                texture = self._ctx.texture((width, height), 4)
                texture.repeat_x = texture.repeat_y = False
            self._kept[key] = texture
        return tuple(self._kept[key] for key in found)

    # Reading the image.

    def point_at(self, u: float, v: float) -> Array | None:
        """Return the (3,) world point of the surface at a place in the image, fractions from the top left."""
        if self._drawn is None:
            return None
        camera = self._drawn.camera
        pixel = (self._drawn.split.within_pane(u) * camera.width, v * camera.height)
        depth = self._renderer.depth_at(self._drawn, *pixel)
        return None if depth is None else camera.unproject(pixel, depth)

    def depths(self) -> Array | None:
        """Return the (H, W) camera z of the surface all over the image, see `ShownImage.depths`."""
        return None if self._drawn is None else self._renderer.depth_map(self._drawn)

    def capture(self, request: RenderRequest) -> Array:
        """Return the image of a request, see `ShownImage.capture`."""
        image = self._renderer.read(request)
        if self._drawn is None or request.projection != self._drawn.projection:
            self._renderer.forget()  # layers of another size, which may be gigabytes
        return image

    def thumbnail(self) -> Image.Image | None:
        """Return the image on screen, of the first pane, small; None while there is none."""
        if not self.textures:
            return None
        texture = self.textures[0]
        image = Image.frombytes("RGBA", texture.size, texture.read()).convert("RGB")
        return ImageOps.fit(ImageOps.flip(image), THUMBNAIL)

    @property
    def waits(self) -> bool:
        """True while another thread rasterizes the image; it calls what `wake_with` was given when it has."""
        return self._background.waits

    @property
    def is_running(self) -> bool:
        """True while other threads are at work, wanted or not."""
        return self._background.worker.is_running or self._merger.worker.is_running

    def wake_with(self, wake: Callable[[], None]) -> None:
        """Have `wake` called on another thread when `update` should be called."""
        self._background.worker.wake = wake

    def close(self) -> None:
        """Take on no more work on other threads."""
        self._background.worker.close()
        self._merger.worker.close()

    def release(self) -> None:
        """Give device memory back; the canvas cannot be used afterwards."""
        for texture in self._kept.values():
            texture.release()
        self._renderer.release()


def _why_nothing(request: RenderRequest) -> str:
    gaussians = request.scene.scene.gaussians
    if len(request.scene.source.gaussians) and not len(gaussians):
        shown = with_key("show what is hidden", editing.show_hidden)
        return f"all of the scene is hidden or deleted: {shown}, or {with_key('undo', editing.undo)}"
    if request.clip != UNCLIPPED and gaussians.valid().any():
        return "nothing of the scene in this picture lies between the cuts: move them in the panel Camera"
    back = with_key("return to the opening view", viewpoint.reset_view)
    reason = why_nothing(gaussians, request.camera)
    return reason if why_undrawable(gaussians) else f"{reason}: {back}"


class AdaptiveResolution:
    """Chooses the level of detail while the camera moves, learned from the times of earlier images."""

    def __init__(self, budget: float = MOVING_BUDGET) -> None:
        """`budget` in milliseconds of an image."""
        self._budget = budget
        self.count = 1  # Gaussians of the next images
        self._each = 4e-4  # milliseconds of a full image for each Gaussian; a guess before one was drawn
        self._shares: dict[Detail, float] = {}  # of the full image's time, measured

    @property
    def is_slow(self) -> bool:
        """True where full images are too slow to follow a movement."""
        return not self.is_quick(FULL)

    def is_quick(self, detail: Detail) -> bool:
        """Return whether an image is expected within the budget."""
        return self._each * self.count * self._share(detail) <= self._budget

    def finest(self, levels: tuple[Detail, ...]) -> Detail:
        """Return the first of `levels` that is expected within the budget, else the last one."""
        return next(filter(self.is_quick, levels), levels[-1])

    def drew(self, detail: Detail, milliseconds: float) -> None:
        """Learn from the time of an image."""
        if detail == FULL:
            self._each = milliseconds / self.count
            # Coarse ones are held to be a little faster with every full image, so that better is tried again.
            self._shares = {other: 0.8 * share for other, share in self._shares.items()}
        elif self._each > 0:
            self._shares[detail] = (self._share(detail) + milliseconds / (self._each * self.count)) / 2

    def _share(self, detail: Detail) -> float:
        """Return the time as a share of a full image's; guessed, a quarter where four are drawn as one."""
        if detail == FULL:
            return 1.0
        return self._shares.get(detail, detail.scale**2 * (0.25 if detail.merged else 1))


M = TypeVar("M")


class Latest(Generic[M]):
    """Computes the latest request on a thread of its own, and drops the results of earlier ones."""

    def __init__(self) -> None:
        self.worker = Worker()
        self._key: object = None  # of what is wanted
        self._made: M | None = None
        self._problem = ""

    @property
    def waits(self) -> bool:
        """True while a request is under way that has not been dropped."""
        return self._key is not None

    def want(self, key: object, make: Callable[[Progress], M]) -> None:
        """Begin to `make` the result of a key, unless it is under way or made."""
        if key != self._key:
            self.drop()
            self._key = key
            self.worker.submit("", make, partial(setattr, self, "_made"), partial(setattr, self, "_problem"))

    def made(self, key: object) -> M | None:
        """Return the result of a key, if it is ready. Raises BackendError, once, where it failed."""
        self.worker.poll()
        problem, self._problem = self._problem, ""
        if problem:
            raise BackendError(problem)
        return self._made if key == self._key else None

    def drop(self) -> None:
        """Cancel the work under way, and drop its result."""
        self.worker.cancel()
        self.worker.poll()  # so that nothing of a job that was left is held
        self._key, self._made, self._problem = None, None, ""
