"""An OpenGL context without a window or a display, and what kind of driver is behind one."""

import sys
from itertools import product
from typing import Any

import moderngl

from langsplat_core.errors import BackendError

# glcontext looks for libGL.so first; images without development packages have only the versioned names.
_VERSIONED = {"libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
VERSIONS = (430, 410)  # 4.3 sorts on the device; some drivers give no more than what is asked for
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swrast", "swr ", "software", "swiftshader", "basic render")


def is_software(ctx: moderngl.Context) -> bool:
    """Whether the driver draws on the CPU."""
    renderer = ctx.info["GL_RENDERER"].lower()
    return any(name in renderer for name in SOFTWARE_RENDERERS)


def create_egl_context() -> moderngl.Context:
    """An OpenGL context of 4.1 or newer that needs no display: EGL on Linux, the system's own way elsewhere.

    Raises BackendError where there is no driver for one.
    """
    linux = sys.platform.startswith("linux")
    attempts: list[dict[str, Any]] = [{"backend": "egl"}, {"backend": "egl", **_VERSIONED}] if linux else [{}]
    problem: Exception | None = None
    for version, options in product(VERSIONS, attempts):
        try:
            return moderngl.create_context(standalone=True, require=version, **options)
        except Exception as error:  # noqa: BLE001  glcontext raises nothing more specific
            problem = error
    advice = "install libegl1 and libgl1-mesa-dri (Debian's names)" if linux else "update the graphics driver"
    raise BackendError(f"no offscreen OpenGL 4.1 ({problem}); {advice}, or use --backend cpu")
