"""Pictures without a window: an offscreen GL context, or none at all. Imports neither glfw nor imgui."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges, compose
from langsplat_core.errors import BackendError, InputError
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.context import create_egl_context
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.drawing.channels import ArrayChannels, Layers
from langsplat_viewer.drawing.frame import Backend, FrameRenderer, suits_opengl
from langsplat_viewer.drawing.looking import VISIBLE_ALPHA, why_nothing
from langsplat_viewer.drawing.seeing import UNCLIPPED, Clip
from langsplat_viewer.drawing.sight import Sight


@dataclass(frozen=True, eq=False)
class Subject:
    """What is drawn, from wherever it is seen."""

    scene: Scene
    picture: PictureConfig = field(default_factory=PictureConfig)
    layers: Layers = field(default_factory=Layers)
    heat_ranges: HeatRanges = ()
    clip: Clip = UNCLIPPED


@dataclass(frozen=True, eq=False)
class Drawn:
    """A picture without a window."""

    image: Array  # (H, W, 3) uint8, row 0 on top
    nothing: bool  # it shows nothing of the scene


@contextmanager
def painter(subject: Subject, backend: Backend = "auto") -> Iterator[Callable[[Camera], Drawn]]:
    """Draws one subject from camera after camera, on the thread that it was made on.

    Backends "cpu" and "cuda" touch no GL at all; "auto" takes "cpu" where GL is absent or software.
    Raises BackendError where the backend cannot work, ValueError where the layers are not the scene's.
    """
    scene, layers = subject.scene, subject.layers
    layers.check(len(scene.gaussians))
    ctx = _context_for(backend)
    if ctx is None:
        channels = ArrayChannels(load_rasterizer("cpu" if backend == "auto" else backend))

        def by_arrays(camera: Camera) -> Drawn:
            found = channels.render(Sight(scene, camera, subject.clip), layers, layers.extra(subject.picture))
            nothing = bool(found.alpha.max(initial=0) < VISIBLE_ALPHA)
            return Drawn(compose(found, subject.picture, subject.heat_ranges), nothing)

        yield by_arrays
        return
    try:
        frame = FrameRenderer(ctx, "opengl")
        frame.set_scene(scene)
        frame.set_clip(subject.clip)
        frame.set_layers(layers.latent_rgb, layers.relevancies)

        def by_gl(camera: Camera) -> Drawn:
            image = frame.read(camera, subject.picture, subject.heat_ranges)
            return Drawn(image, frame.shows_nothing())

        yield by_gl
    finally:
        ctx.release()


def render_picture(
    scene: Scene,
    camera: Camera,
    picture: PictureConfig,
    *,
    backend: Backend = "auto",
    latent_rgb: Array | None = None,
    relevancies: Array | None = None,
    heat_ranges: HeatRanges = (),
) -> Array:
    """(H, W, 3) uint8 picture of `scene`, row 0 on top, (H, W, 4) where it is transparent; layers as in
    `FrameRenderer.set_layers`.

    Raises what `painter` does, and InputError where nothing of the scene shows.
    """
    subject = Subject(scene, picture, Layers(latent_rgb, relevancies), heat_ranges)
    with painter(subject, backend) as paint:
        return draw_something(subject, camera, paint)


def draw_something(subject: Subject, camera: Camera, paint: Callable[[Camera], Drawn]) -> Array:
    """(H, W, 3) uint8 picture. InputError where it shows nothing of the scene."""
    drawn = paint(camera)
    if drawn.nothing:
        scene = subject.scene
        raise InputError(
            f"{scene.path}: {why_nothing(scene.gaussians, camera)}; try another --camera or scene"
        )
    return drawn.image


def _context_for(backend: Backend) -> moderngl.Context | None:
    """A context to draw with; None where the backend needs none."""
    if backend not in ("auto", "opengl"):
        return None
    try:
        ctx = create_egl_context()
    except BackendError:
        if backend == "auto":
            return None
        raise
    if backend == "auto" and not suits_opengl(ctx):
        ctx.release()
        return None
    return ctx
