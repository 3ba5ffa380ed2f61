"""Pictures without a window: an offscreen GL context, or none at all. Imports neither glfw nor imgui."""

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.compose import HeatRanges, compose
from langsplat_core.errors import BackendError
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.context import create_egl_context
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.channels import ArrayChannels, Layers
from langsplat_viewer.frame import Backend, FrameRenderer, suits_opengl


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
    """(H, W, 3) uint8 picture of `scene`, row 0 on top; layers as in `FrameRenderer.set_layers`.

    Backends "cpu" and "cuda" touch no GL at all; "auto" takes "cpu" where GL is absent or software.
    Raises BackendError where the backend cannot work.
    """
    layers = Layers(latent_rgb, relevancies)
    layers.check(len(scene.gaussians))
    ctx = _context_for(backend)
    if ctx is None:
        rasterizer = load_rasterizer("cpu" if backend == "auto" else backend)
        channels = ArrayChannels(rasterizer).render(scene, layers, camera, layers.extra(picture))
        return compose(channels, picture, heat_ranges)
    try:
        frame = FrameRenderer(ctx, "opengl")
        frame.set_scene(scene)
        frame.set_layers(latent_rgb, relevancies)
        return frame.read(camera, picture, heat_ranges)
    finally:
        ctx.release()


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
