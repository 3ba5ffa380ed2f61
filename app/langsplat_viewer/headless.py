"""Pictures without a window: an offscreen GL context, or none at all. Imports neither glfw nor imgui."""

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges, compose
from langsplat_core.errors import BackendError, InputError
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.context import create_egl_context
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.channels import ArrayChannels, Layers
from langsplat_viewer.frame import Backend, FrameRenderer, suits_opengl
from langsplat_viewer.looking import VISIBLE_ALPHA, why_nothing


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

    Backends "cpu" and "cuda" touch no GL at all; "auto" takes "cpu" where GL is absent or software.
    Raises BackendError where the backend cannot work, InputError where nothing of the scene shows.
    """
    layers = Layers(latent_rgb, relevancies)
    layers.check(len(scene.gaussians))
    ctx = _context_for(backend)
    if ctx is None:
        rasterizer = load_rasterizer("cpu" if backend == "auto" else backend)
        channels = ArrayChannels(rasterizer).render(scene, layers, camera, layers.extra(picture))
        _check_something(scene, camera, bool(channels.alpha.max(initial=0) < VISIBLE_ALPHA))
        return compose(channels, picture, heat_ranges)
    try:
        frame = FrameRenderer(ctx, "opengl")
        frame.set_scene(scene)
        frame.set_layers(latent_rgb, relevancies)
        image = frame.read(camera, picture, heat_ranges)
        _check_something(scene, camera, frame.shows_nothing())
        return image
    finally:
        ctx.release()


def _check_something(scene: Scene, camera: Camera, nothing: bool) -> None:
    if nothing:
        raise InputError(
            f"{scene.path}: {why_nothing(scene.gaussians, camera)}; try another --camera or scene"
        )


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
