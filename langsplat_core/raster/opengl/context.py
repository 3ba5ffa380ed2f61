"""An OpenGL context without a window or a display."""

import sys
from typing import Any

import moderngl

from langsplat_core.errors import BackendError

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
