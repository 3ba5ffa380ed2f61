"""Small tools for drawing with moderngl: sources, uniforms, a pass that leaves the state as it was."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files

import moderngl

SHADERS = "langsplat_core.raster.opengl.shaders"


def shader(name: str, version: int = 410, package: str = SHADERS, **defines: int | float) -> str:
    """Source of `name`.glsl in `package` with its GLSL version and `defines` in front."""
    head = [f"#version {version} core", *(f"#define {key} {value}" for key, value in defines.items())]
    return "\n".join([*head, files(package).joinpath(f"{name}.glsl").read_text(encoding="utf-8")])


def set_uniforms(program: moderngl.Program | moderngl.ComputeShader, values: dict[str, object]) -> None:
    """Set uniforms by name; names that the compiler removed as unused are passed over."""
    for name, value in values.items():
        uniform = program.get(name, None)
        if isinstance(uniform, moderngl.Uniform):
            if isinstance(value, bytes):
                uniform.write(value)
            else:
                uniform.value = value


@contextmanager
def drawing(ctx: moderngl.Context, framebuffer: moderngl.Framebuffer, flags: int) -> Iterator[None]:
    """Draw into `framebuffer` with only `flags` enabled, then bind again what was bound before.

    Blending and all other switches end up off, the blend function is moderngl's default and the colour
    masks are those of the framebuffer bound before: a user interface drawn next finds a plain state.
    """
    # A standalone context begins with nothing bound. moderngl binds the last framebuffer again whenever it
    # makes one, which fails if that was released meanwhile: so the default one is bound, never ours.
    before = ctx.fbo or ctx.detect_framebuffer(0)
    framebuffer.use()
    ctx.enable_only(flags)
    try:
        yield
    finally:
        ctx.enable_only(moderngl.NOTHING)
        ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        before.use()


class Targets:
    """The images that one pass draws: RGBA, then depth as RG (sum of weight * camera z, alpha)."""

    def __init__(self, ctx: moderngl.Context, key: tuple[int, int, int, bool], dtype: str) -> None:
        self.key = key
        width, height, values, depth = key
        images = [ctx.texture((width, height), 4, dtype=dtype) for _ in range(values)]
        if depth:  # always single: half floats would give it 11 bits, and none beyond 65504 units
            images.append(ctx.texture((width, height), 2, dtype="f4"))
        for image in images:
            image.repeat_x = image.repeat_y = False
        self.images = tuple(images)
        self.framebuffer = ctx.framebuffer(images)

    def release(self) -> None:
        """Give the device memory back."""
        self.framebuffer.release()
        for image in self.images:
            image.release()
