"""The frame renderer: composition, backends, caching, picking, headless pictures."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS, Channels, compose
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera, Gaussians, Scene, look_at
from langsplat_viewer.rendering.depth import ArrayChannels, Layers, depth_range
from langsplat_viewer.rendering.renderer import ArraySource, GlRenderer, GlSource, suits_opengl
from tests.support.gl_context import gl_state
from tests.support.scenes import random_camera, random_gaussians, random_values

COUNT = 150
SCENE = Scene(random_gaussians(COUNT, sh_degree=3))
CAMERA = random_camera(1, distance=2.0)
LATENT = random_values(COUNT, 3, 1)
RELEVANCIES = random_values(COUNT, 2, 2)
RANGES = ((0.5, 0.9), (0.5, 0.6))
PICTURE = PictureConfig(background=(0.2, 0.5, 0.9))


@pytest.fixture(params=["opengl", "cpu"])
def frame(gl, request):
    renderer = GlRenderer(gl, request.param, "single")
    renderer.set_scene(SCENE)
    renderer.set_layers(LATENT, RELEVANCIES)
    yield renderer
    renderer.release()


def largest_difference(a: Array, b: Array) -> int:
    return int(np.abs(a.astype(int) - b.astype(int)).max())


def random_channels(seed: int, queries: int) -> Channels:
    """Alpha from 0 to 1 with many pixels about the gate, colours beyond 1, depths beyond the range."""
    rng = np.random.default_rng(seed)
    shape = (40, 50)
    alpha = np.clip(rng.normal(0.4, 0.35, size=shape), 0, 1).astype(np.float32)
    premultiplied = rng.uniform(size=(*shape, 3 + 3 + queries)).astype(np.float32) * alpha[..., None]
    return Channels(
        rgb=premultiplied[..., :3] * 1.3,
        alpha=alpha,
        latent=premultiplied[..., 3:6],
        relevancies=premultiplied[..., 6:],
        depth_sum=rng.uniform(0.5, 4.0, size=shape).astype(np.float32) * alpha,
        depth_range=(1.0, 3.0),
    )


@pytest.mark.parametrize("queries", [1, 2, 3])
@pytest.mark.parametrize("display", DISPLAYS)
def test_the_shader_composes_as_numpy_does(gl, monkeypatch, display, queries):
    channels = random_channels(queries, queries)
    extra = Layers(LATENT, RELEVANCIES).extra(PictureConfig(display=display))
    fields = {"latent": ("latent",), "relevancies": ("relevancies",), "depth": ("depth_sum",)}.get(extra, ())
    others = {"latent", "relevancies", "depth_sum"} - set(fields)
    shown = replace(channels, **dict.fromkeys(others))
    monkeypatch.setattr(ArrayChannels, "render_all", lambda *_: [shown])
    monkeypatch.setattr("langsplat_viewer.drawing.frame.depth_range", lambda *_: channels.depth_range)
    renderer = GlRenderer(gl, "cpu")
    renderer.set_scene(SCENE)
    renderer.set_layers(LATENT, random_values(COUNT, queries))
    picture = replace(PICTURE, display=display, heat_opacity=0.8, dim=0.4, threshold=0.55, alpha_gate=0.25)
    for ranges in ((), ((0.5, 0.9),), ((0.5, 0.9), (0.4, 0.52), (0.0, 0.7))[:queries]):
        got = renderer.read(CAMERA.resized(50, 40), picture, ranges)
        assert largest_difference(got, compose(shown, picture, ranges)) <= 1
    renderer.release()


@pytest.mark.parametrize("colour_map", COLOUR_MAPS)
@pytest.mark.parametrize("display", ["relevancy", "depth"])
def test_the_shader_maps_colours_as_numpy_does(gl, monkeypatch, display, colour_map):
    check_composition(gl, monkeypatch, replace(PICTURE, display=display, colour_map=colour_map))


@pytest.mark.parametrize("display", DISPLAYS)
def test_the_shader_is_transparent_where_numpy_is(gl, monkeypatch, display):
    check_composition(gl, monkeypatch, replace(PICTURE, display=display, transparent=True))


def check_composition(gl, monkeypatch, picture: PictureConfig) -> None:
    """One query; the channels as numbers, whatever the rasterizer."""
    channels = random_channels(5, 1)
    extra = DISPLAYS[picture.display].extra
    field = {"latent": "latent", "relevancies": "relevancies", "depth": "depth_sum"}.get(extra, "")
    shown = replace(channels, **dict.fromkeys({"latent", "relevancies", "depth_sum"} - {field}))
    monkeypatch.setattr(ArrayChannels, "render_all", lambda *_: [shown])
    monkeypatch.setattr("langsplat_viewer.drawing.frame.depth_range", lambda *_: channels.depth_range)
    renderer = GlRenderer(gl, "cpu")
    renderer.set_scene(SCENE)
    renderer.set_layers(LATENT, random_values(COUNT, 1))
    got = renderer.read(CAMERA.resized(50, 40), picture, ((0.5, 0.9),))
    expected = compose(shown, picture, ((0.5, 0.9),))
    assert got.shape == expected.shape == (40, 50, 4 if picture.transparent else 3)
    assert largest_difference(got, expected) <= 1
    renderer.release()


@pytest.mark.parametrize("display", DISPLAYS)
def test_the_picture_is_that_of_the_reference(frame, display):
    """Either backend against float64 channels composed in NumPy. Pixels at a threshold or at a cut-off
    of image formation may flip; all others agree to 2/255."""
    picture = replace(PICTURE, display=display)
    got = frame.read(CAMERA, picture, RANGES)
    assert got.shape == (CAMERA.height, CAMERA.width, 3)
    difference = np.abs(got.astype(int) - reference_picture(picture)).max(-1)
    assert (difference > 2).mean() <= 2e-3


def reference_picture(picture: PictureConfig) -> Array:
    from langsplat_core.raster.reference import colours

    gaussians = SCENE.gaussians
    view = ReferenceRasterizer().view(gaussians, CAMERA)
    rgb = colours(gaussians.sh, gaussians.means, CAMERA.position)
    image, alpha = view.splat(np.concatenate([rgb, LATENT, RELEVANCIES, view.footprints.depths[:, None]], 1))
    depths = depth_range(gaussians, CAMERA)
    channels = Channels(image[..., :3], alpha, image[..., 3:6], image[..., 6:8], image[..., 8], depths)
    return compose(channels, picture, RANGES)


def test_the_backends_agree_on_a_screen(gl):
    """Half floats, the viewer's default, against the CPU rasterizer."""
    pictures = []
    for backend in ("opengl", "cpu"):
        renderer = GlRenderer(gl, backend)
        renderer.set_scene(SCENE)
        pictures.append(renderer.read(CAMERA, PICTURE))
        renderer.release()
    assert largest_difference(*pictures) <= 3


def test_a_missing_layer_shows_the_plain_colours(frame):
    frame.set_layers(None, None)
    plain = frame.read(CAMERA, PICTURE)
    for display in (row.name for row in DISPLAYS.values() if row.needs_field):
        assert largest_difference(frame.read(CAMERA, replace(PICTURE, display=display)), plain) == 0


def test_layers_of_another_shape_are_refused(frame):
    with pytest.raises(ValueError, match="latent_rgb"):
        frame.set_layers(LATENT[:-1], None)
    with pytest.raises(ValueError, match="relevancies"):
        frame.set_layers(None, random_values(COUNT, 4))


def counted(method, calls: list):
    """`method`, which also notes its arguments."""

    def noting(*arguments):
        calls.append(arguments)
        return method(*arguments)

    return noting


def test_channels_are_kept_while_only_the_picture_settings_change(frame, monkeypatch):
    calls = []
    for source in (GlSource, ArraySource):
        monkeypatch.setattr(source, "render", counted(source.render, calls))
    heat = replace(PICTURE, display="relevancy")
    first = frame.read(CAMERA, heat, RANGES)
    assert largest_difference(first, frame.read(CAMERA, replace(heat, heat_opacity=0.1), RANGES)) > 20
    frame.read(CAMERA, replace(heat, display="segmentation"), RANGES)
    assert len(calls) == 1
    frame.read(replace(CAMERA, name="same view"), heat, RANGES)
    assert len(calls) == 1
    frame.read(random_camera(4), heat, RANGES)
    assert len(calls) == 2
    frame.set_layers(LATENT, 1 - RELEVANCIES)
    assert largest_difference(frame.read(CAMERA, heat, RANGES), first) > 20
    frame.set_scene(Scene(random_gaussians(20, 3)))
    frame.read(CAMERA, heat)
    assert len(calls) == 4


def wall(colour: tuple[float, float, float], centre: tuple[float, float, float], width: float) -> Gaussians:
    """One opaque disc that faces the z axis."""
    return Gaussians(
        means=np.array([centre]),
        log_scales=np.log([[width, width, 1e-3]]),
        quats_wxyz=np.array([[1.0, 0, 0, 0]]),
        opacity_logits=np.array([np.inf]),
        sh=((np.array([[colour]]) - 0.5) / 0.28209479),
    )


FRONT = Camera(64, 48, 60.0, 60.0, 32.0, 24.0, np.eye(4))


def test_row_0_is_the_top(gl):
    """y points down: a red disc above the axis belongs into the upper half."""
    for backend in ("opengl", "cpu"):
        renderer = GlRenderer(gl, backend)
        renderer.set_scene(Scene(wall((1, 0, 0), (0, -1.0, 4.0), 0.2)))
        red = renderer.read(FRONT, PictureConfig())[..., 0].astype(float)
        assert red[:24].sum() > 100 * max(red[24:].sum(), 1)
        renderer.release()


def test_the_viewport_alone_is_drawn_and_stretched(gl, frame):
    target = gl.framebuffer([gl.texture((200, 150), 4)])
    target.clear(1.0, 0.0, 1.0)
    target.viewport = (30, 20, 2 * CAMERA.width, 2 * CAMERA.height)
    frame.draw(target, CAMERA, PICTURE)
    assert gl.fbo is target
    target.viewport = (0, 0, 200, 150)
    pixels = np.frombuffer(target.read(components=3), np.uint8).reshape(150, 200, 3)[::-1]
    inside = pixels[150 - 20 - 2 * CAMERA.height : 150 - 20, 30 : 30 + 2 * CAMERA.width]
    small = inside.reshape(CAMERA.height, 2, CAMERA.width, 2, 3).mean((1, 3))
    assert np.abs(small - frame.read(CAMERA, PICTURE)).mean() < 2
    outside = np.ones((150, 200), bool)
    outside[150 - 20 - 2 * CAMERA.height : 150 - 20, 30 : 30 + 2 * CAMERA.width] = False
    assert (pixels[outside] == (255, 0, 255)).all()
    gl.detect_framebuffer(0).use()
    target.release()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks libGL.so.1")
def test_a_user_interface_finds_a_plain_state(gl, frame):
    target = gl.framebuffer([gl.texture((64, 64), 4)])
    target.use()
    gl.enable_only(0)
    gl.blend_func = 0x0302, 0x0303  # source alpha, 1 - source alpha
    before = gl_state()
    frame.draw(target, CAMERA, replace(PICTURE, display="relevancy"), RANGES)
    np.testing.assert_array_equal(gl_state(), before)
    gl.detect_framebuffer(0).use()
    target.release()


def test_picking_finds_the_surface(gl):
    """An opaque disc at z = 4 behind a faint one at z = 2: the surface is the opaque one."""
    solid, veil = wall((1, 1, 1), (0, 0, 4.0), 0.5), wall((0, 0, 1), (0, 0, 2.0), 0.5)
    faint = replace(veil, opacity_logits=np.array([-1.0]))
    fields = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh")
    both = Gaussians(*(np.concatenate([getattr(solid, f), getattr(faint, f)]) for f in fields))
    for backend in ("opengl", "cpu"):
        renderer = GlRenderer(gl, backend)
        assert renderer.depth_at(32, 24) is None
        assert renderer.depth_map() is None
        renderer.set_scene(Scene(both))
        assert renderer.depth_at(32, 24) is None  # nothing drawn yet
        renderer.read(FRONT, PictureConfig())
        assert renderer.depth_at(32.0, 24.0) == pytest.approx(4.0, rel=1e-5)
        assert renderer.depth_at(0.5, 0.5) is None
        depths = renderer.depth_map()
        assert depths.shape == (FRONT.height, FRONT.width)
        assert depths[24, 32] == pytest.approx(renderer.depth_at(32.0, 24.0), rel=0.2)  # the mean on a device
        assert depths[0, 0] == 0
        assert renderer.depth_at(-1.0, 3.0) is None
        assert renderer.depth_at(64.0, 3.0) is None
        renderer.set_scene(Scene(faint))
        renderer.read(FRONT, PictureConfig())
        assert renderer.depth_at(32.0, 24.0) == pytest.approx(
            2.0, rel=1e-5
        )  # the mean: half is never reached
        renderer.release()


@pytest.mark.parametrize("size", [(1, 1), (7, 1), (33, 21), (70, 45)])
def test_every_size(frame, size):
    assert frame.read(CAMERA.resized(*size), PICTURE).shape == (size[1], size[0], 3)


def test_without_a_scene_and_with_an_empty_one_the_background_shows(gl):
    for backend in ("opengl", "cpu"):
        renderer = GlRenderer(gl, backend)
        want = np.round(255 * np.array(PICTURE.background))
        assert np.abs(renderer.read(CAMERA, PICTURE) - want).max() <= 1
        renderer.set_scene(Scene(SCENE.gaussians.take(np.zeros(COUNT, bool))))
        for display in ("rgb", "depth"):
            picture = renderer.read(CAMERA, replace(PICTURE, display=display))
            assert np.abs(picture - want).max() <= 1
        assert renderer.depth_at(3, 3) is None
        renderer.release()


def test_auto_takes_the_cpu_where_the_driver_is_software(gl):
    renderer = GlRenderer(gl)
    assert renderer.backend == ("opengl" if suits_opengl(gl) else "cpu")
    renderer.release()


OLD_DRIVER = """
import moderngl
from langsplat_core.config import PictureConfig
from langsplat_core.errors import BackendError
from langsplat_core.scene import Scene
from langsplat_viewer.rendering.renderer import GlRenderer
from tests.support.scenes import random_camera, random_gaussians
ctx = moderngl.create_context(standalone=True, backend="egl", require=330)
assert ctx.version_code == 330, ctx.version_code
renderer = GlRenderer(ctx)
renderer.set_scene(Scene(random_gaussians(20)))
print(renderer.backend, renderer.read(random_camera(), PictureConfig()).any(), ctx.error)
try:
    GlRenderer(ctx, "opengl")
except BackendError as error:
    print(error)
"""


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Mesa's override")
def test_opengl_3_3_is_enough_with_the_cpu_rasterizer(gl):
    if "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    older = {"MESA_GL_VERSION_OVERRIDE": "3.3FC", "MESA_GLSL_VERSION_OVERRIDE": "330"}
    run = subprocess.run(
        [sys.executable, "-c", OLD_DRIVER], env=os.environ | older, capture_output=True, text=True
    )
    first, second = run.stdout.splitlines()[:2] or [run.stderr, ""]
    assert first.split() == ["cpu", "True", "GL_NO_ERROR"]
    assert "needs OpenGL 4.1, this driver offers 3.3" in second


def test_depth_range_covers_what_is_in_view():
    camera = look_at(np.array([0.0, 0, -5]), np.zeros(3), np.array([0.0, -1, 0]), (64, 48))
    near, far = depth_range(random_gaussians(500), camera)
    assert 4 < near < 4.6
    assert 5.4 < far < 6
    assert depth_range(random_gaussians(0), camera) == (0.0, 1.0)
