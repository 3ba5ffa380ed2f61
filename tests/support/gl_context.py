"""The one place that makes an OpenGL context for tests. `conftest.py` offers these fixtures to all."""

import ctypes
from collections.abc import Iterator

import moderngl
import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl.scene_textures import create_egl_context


@pytest.fixture(scope="session")
def gl_session() -> Iterator[moderngl.Context]:
    """One offscreen context for the whole run; for what is dear to make. Tests take `gl`."""
    try:
        ctx = create_egl_context()
    except BackendError as error:
        pytest.skip(str(error))
    yield ctx
    ctx.release()


@pytest.fixture
def gl(gl_session: moderngl.Context) -> Iterator[moderngl.Context]:
    """The context, current; a GL error left behind fails the test."""
    with gl_session:
        gl_session.clear_errors()
        yield gl_session
        assert gl_session.error == "GL_NO_ERROR"


def gl_state() -> Array:
    """What a user interface drawn next would trip over, asked of the driver itself."""
    library = ctypes.CDLL("libGL.so.1")
    blend, cull, depth_test, scissor_test = 0x0BE2, 0x0B44, 0x0B71, 0x0C11
    enabled = [int(library.glIsEnabled(flag)) for flag in (blend, cull, depth_test, scissor_test)]
    blend_source, blend_target, blend_equation, viewport, framebuffer = 0x80C9, 0x80C8, 0x8009, 0x0BA2, 0x8CA6
    numbers = []
    for name in (blend_source, blend_target, blend_equation, viewport, framebuffer):
        buffer = (ctypes.c_int * 4)(-1, -1, -1, -1)
        library.glGetIntegerv(name, buffer)
        numbers += list(buffer)
    masks = (ctypes.c_ubyte * 4)()
    library.glGetBooleanv(0x0C23, masks)
    return np.array([*enabled, *numbers, *masks])
