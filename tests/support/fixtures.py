"""Fixtures that `conftest.py` offers to all: OpenGL contexts, and figures that accuracy tests measured."""

import ctypes
from collections.abc import Callable, Iterator
from itertools import chain

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


Measure = Callable[[str, str, float], None]


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Measure:
    """measured(group, quantity, value): remember one figure; the table shows count, largest and sum."""

    def remember(group: str, quantity: str, value: float) -> None:
        record_property(f"{group}: {quantity}", float(value))

    return remember


def print_measured(reporter: pytest.TerminalReporter) -> None:
    """Print, with `--slow` or `--measured`, everything remembered in this run, by whichever worker."""
    rows: dict[str, list[float]] = {}
    for report in chain.from_iterable(reporter.stats.values()):
        if getattr(report, "when", "") == "call":
            for label, value in report.user_properties:
                rows.setdefault(label, []).append(value)
    if not rows:
        return
    reporter.write_sep("-", "measured")
    reporter.write_line(f"{'':<58} {'count':>6} {'largest':>10} {'sum':>10}")
    for label, values in sorted(rows.items()):
        reporter.write_line(f"{label:<58} {len(values):>6} {max(values):>10.3g} {sum(values):>10.4g}")
