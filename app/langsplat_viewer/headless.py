"""Pictures without a window: an offscreen GL context, or none at all. Imports neither glfw nor imgui."""

import sys
from typing import Any

import moderngl

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.errors import BackendError
from langsplat_core.query.picture import compose
from langsplat_core.scene import Camera, Scene
from langsplat_viewer.channels import CpuChannels, Layers
from langsplat_viewer.frame import Backend, FrameRenderer, is_software

# glcontext looks for libGL.so first; images without development packages have only the versioned names.
_VERSIONED = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}


def create_egl_context() -> moderngl.Context:
    """An OpenGL 4.1 context that needs no display: EGL on Linux, the system's own way elsewhere.

    Raises BackendError where there is no driver for one.
    """
    linux = sys.platform.startswith("linux")
    attempts: list[dict[str, Any]] = [{"backend": "egl"}, {"backend": "egl", **_VERSIONED}] if linux else [{}]
    problem: Exception | None = None
    for options in attempts:
        try:
            return moderngl.create_context(standalone=True, require=410, **options)
        except Exception as error:  # noqa: BLE001  glcontext raises nothing more specific
            problem = error
    advice = "install libegl1 and libgl1-mesa-dri (Debian's names)" if linux else "update the graphics driver"
    raise BackendError(f"no offscreen OpenGL 4.1 ({problem}); {advice}, or use --backend cpu")


def render_picture(
    scene: Scene,
    camera: Camera,
    picture: PictureConfig,
    *,
    backend: Backend = "auto",
    latent_rgb: Array | None = None,
    relevancies: Array | None = None,
    heat_peaks: tuple[float, ...] = (),
) -> Array:
    """(H, W, 3) uint8 picture of `scene`, row 0 on top; layers as in `FrameRenderer.set_layers`.

    Backend "cpu" touches no GL at all; "auto" takes it where GL is absent or software. Raises
    BackendError where "opengl" cannot work.
    """
    layers = Layers(latent_rgb, relevancies)
    layers.check(len(scene.gaussians))
    ctx = None if backend == "cpu" else _context_for(backend)
    if ctx is None:
        channels = CpuChannels().render(scene, layers, camera, layers.extra(picture))
        return compose(channels, picture, heat_peaks)
    try:
        frame = FrameRenderer(ctx, "opengl")
        frame.set_scene(scene)
        frame.set_layers(latent_rgb, relevancies)
        return frame.read(camera, picture, heat_peaks)
    finally:
        ctx.release()


def _context_for(backend: Backend) -> moderngl.Context | None:
    """A context to draw with; None where "auto" does better without."""
    try:
        ctx = create_egl_context()
    except BackendError:
        if backend == "auto":
            return None
        raise
    if backend == "auto" and is_software(ctx):
        ctx.release()
        return None
    return ctx
