"""What the display can do, before a window is opened on it."""

import os
import sys
import warnings

from imgui_bundle import glfw_utils  # noqa: F401  isort: skip  (before glfw: it brings a library of its own)
import glfw  # isort: skip

from langsplat_core.errors import BackendError

# 4.3 sorts splats, 4.1 draws them on every system; 3.3 still shows the CPU's pictures.
GL_VERSIONS = ((4, 3), (4, 1), (3, 3))


def probe_gl() -> tuple[int, int]:
    """The newest of `GL_VERSIONS` that a window can have here. Raises BackendError without a display."""
    hint = "to draw a picture without a window add --headless --out picture.png"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)
        is_linux = sys.platform.startswith("linux")
        if is_linux and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise BackendError(f"no display to open a window on (DISPLAY is not set); {hint}")
        if not glfw.init():
            raise BackendError(f"the display cannot be reached; {hint}")
        for major, minor in GL_VERSIONS:
            glfw.window_hint(glfw.VISIBLE, False)
            _gl_hints(major, minor)
            window = glfw.create_window(16, 16, "probe", None, None)
            glfw.default_window_hints()
            if window:
                glfw.destroy_window(window)
                return major, minor
    raise BackendError(f"the display offers no OpenGL 3.3; update the graphics driver, or {hint}")


def _gl_hints(major: int, minor: int) -> None:
    glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, major)
    glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, minor)
    glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
    glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
