"""The OpenGL rasterizer, and the sources of shaders: one text for OpenGL 4.1 and WebGL 2 (GLSL ES 3.00)."""

from importlib.resources import files

WEB = "300 es"
# GLSL ES has no default precision of these types in fragment shaders, and no `precise`, which only keeps a
# compiler from reordering one subtraction.
_WEB_HEAD = (
    *(f"precision highp {kind};" for kind in ("float", "int", "sampler2D", "sampler2DArray")),
    "#define precise",
)


def shader(
    name: str, version: str = "410 core", package: str = __name__, **defines: int | float | str
) -> str:
    """Return the source of `name`.glsl in `package` with its GLSL version and `defines` in front."""
    head = [f"#version {version}", *(_WEB_HEAD if version == WEB else ())]
    head += [f"#define {key} {value}" for key, value in defines.items()]
    return "\n".join([*head, files(package).joinpath(f"{name}.glsl").read_text(encoding="utf-8")])


def splat_shaders(values: int, depth: bool, version: str = "410 core") -> tuple[str, str]:
    """Return the vertex and fragment shader that splat `values` images, and depth."""
    each = {"EACH_VALUE(DO)": " ".join(f"DO({number})" for number in range(values))}
    vertex, fragment = (
        shader(name, version, VALUES=values, DEPTH=int(depth), **each)
        for name in ("splat.vert", "splat.frag")
    )
    return vertex, fragment
