"""The one place that makes an OpenGL context for tests. `conftest.py` offers these fixtures to all."""

from collections.abc import Iterator

import moderngl
import pytest

from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl.context import create_egl_context


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
