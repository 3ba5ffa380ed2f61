"""OpenGL through EGL on the driver of the GPU: time, and error against a reference that blends as it does."""

from collections.abc import Iterator
from dataclasses import replace

import moderngl

from gpu_sections import Missing, Plan
from gpu_sections.pictures import bundled_scene
from langsplat_core.config import INRIA
from langsplat_core.errors import BackendError
from langsplat_core.lab.speed.cases import Case, default_camera, random_scene
from langsplat_core.lab.speed.measure import Foresight, warm_up
from langsplat_core.lab.speed.measure import measure as measure_backend
from langsplat_core.lab.speed.report import table as speed_table
from langsplat_core.lab.speed.truth import make_truth
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.scene_textures import create_egl_context
from langsplat_viewer.rendering.renderer import is_software

SIZE = (960, 720)
ENDLESS = replace(INRIA, transmittance_min=0.0)  # OpenGL cannot stop where a pixel is full


def measure(plan: Plan) -> Iterator[str]:
    """The bundled scene and a large random one, in both precisions."""
    try:
        context = create_egl_context()
    except BackendError as error:
        raise Missing(f"no OpenGL: {error}") from error
    with context:
        if is_software(context):
            raise Missing(f"no GPU's OpenGL driver, only {context.info['GL_RENDERER']}")
        yield from tables(plan, context)


def tables(plan: Plan, context: moderngl.Context) -> Iterator[str]:
    """On any driver."""
    yield f"# OpenGL through EGL: {context.info['GL_RENDERER']}\n"
    yield "Errors against the float64 reference without its early stop, which OpenGL has not.\n"
    scene = bundled_scene(plan)
    cases = [
        Case("bundled", scene.gaussians, scene.cameras[0].resized(*SIZE)),
        Case("random", random_scene(plan.million), default_camera(*SIZE)),
    ]
    backends = [load_rasterizer("opengl", ctx=context, precision=p) for p in ("single", "half")]
    warm_up(backends, (3,))
    for case in cases:
        truth = make_truth(case.gaussians, case.camera, ENDLESS)
        rows = []
        for backend in backends:
            rows += measure_backend(backend, case, 3, truth, Foresight(30.0))
        yield speed_table(rows)
