"""Renderers: rasterizing and compositing, what is kept between requests, picking, missing drivers."""

import gc
import os
import subprocess
import sys
from dataclasses import fields, replace

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig
from langsplat_core.display.composing import compose
from langsplat_core.display.displays import COLOUR_MAPS, DISPLAYS, HEAT_BASE, Channels, Subject, heats
from langsplat_core.raster import load_rasterizer
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.protocol import far_plane
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians, Scene, look_at
from langsplat_viewer.actions import editing, settings, viewpoint
from langsplat_viewer.camera.controls import default_view, extent_of, from_camera
from langsplat_viewer.marks import Marks
from langsplat_viewer.rendering import renderer as renderers
from langsplat_viewer.rendering.renderer import ArrayRenderer, GlRenderer, renderer_for
from langsplat_viewer.rendering.request import (
    Clip,
    RenderRequest,
    Split,
    depth_range,
    edited_scene,
    image_formation,
    plain_request,
    why_nothing,
    why_undrawable,
)
from tests.support.backends import gl_state
from tests.support.fakes import blob_scene
from tests.support.scenes import random_answer, random_camera, random_gaussians, random_scene, with_tree
from tests.support.windowless import marked

COUNT = 150
SCENE = with_tree(random_scene(COUNT))
CAMERA = random_camera(1, distance=2.0)
ANSWERS = (random_answer(COUNT, 2), random_answer(COUNT, 7, heat_range=(0.5, 0.6)), random_answer(COUNT, 11))
PICTURE = PictureConfig(background=(0.2, 0.5, 0.9))


def request_for(display: str = "rgb", queries: int = 2, **more) -> RenderRequest:
    picture = replace(PICTURE, display=display)
    return plain_request(SCENE, CAMERA, picture, answers=ANSWERS[:queries], **more)


@pytest.fixture(params=["opengl", "cpu"])
def renderer(gl, request):
    made = renderer_for(gl, request.param)
    yield made
    made.release()


def largest_difference(a: Array, b: Array) -> int:
    return int(np.abs(a.astype(int) - b.astype(int)).max())


# Compositing.


def random_channels(seed: int, display: str, queries: int) -> Channels:
    """Alpha from 0 to 1 with many pixels about the gate, colours beyond 1, depths beyond the range."""
    rng = np.random.default_rng(seed)
    alpha = np.clip(rng.normal(0.4, 0.35, size=(40, 50)), 0, 1).astype(np.float32)
    count = {"latent": 3, "tree": 3, "relevancy": queries, "segmentation": queries}.get(display, 1)
    rgb = rng.uniform(size=(40, 50, 3)).astype(np.float32) * alpha[..., None] * 1.3
    if DISPLAYS[display].channel is None:
        return Channels(rgb, alpha)
    low, high = (0.5, 4.0) if display == "depth" else (0.0, 1.0)
    return Channels(rgb, alpha, rng.uniform(low, high, (40, 50, count)).astype(np.float32) * alpha[..., None])


class DrawnAlready:
    """A rasterizer, and its view, whose splats are these channels whatever is splatted."""

    name = "cpu"
    rows = np.arange(COUNT)

    def __init__(self, channels: Channels) -> None:
        extra = channels.rgb[..., :0] if channels.extra is None else channels.extra
        self.image, self.alpha = np.concatenate([channels.rgb, extra], 2), channels.alpha

    def view(self, gaussians: Gaussians, camera: Camera, *settings: object) -> "DrawnAlready":
        self.camera = camera
        return self

    def splat_rows(self, values: Array) -> tuple[Array, Array]:
        assert values.shape == (COUNT, self.image.shape[2])
        return self.image, self.alpha


class OnDevice:
    """The same with textures, as the rasterizer on a graphics device has them: alpha last."""

    name = "opengl"

    def __init__(self, ctx, made: DrawnAlready) -> None:
        self.ctx, self.made, self.view = ctx, made, made.view

    def scene(self, gaussians: Gaussians) -> "OnDevice":
        return self

    def upload(self, values: Array) -> object:
        return self.ctx.texture((1, 1), 4)

    def draw(self, view: object, sources: list, with_depth: bool):
        image, alpha = self.made.image, self.made.alpha[..., None]
        textures, parts = [], [image[..., :3], image[..., 3:]][: len(sources) + with_depth]
        for part, components in zip(parts, (4, 2 if with_depth else 4), strict=False):
            padded = np.zeros((*alpha.shape[:2], components), np.float32)
            padded[..., : part.shape[2]] = part
            padded[..., -1:] = alpha
            texture = self.ctx.texture(alpha.shape[1::-1], components, padded.tobytes(), dtype="f4")
            texture.repeat_x = texture.repeat_y = False
            textures.append(texture)
        return textures

    def release(self) -> None:
        pass


SHOWN = [(display, queries, {}) for display in DISPLAYS for queries in (1, 2, 3)]
SHOWN += [(display, 1, {"transparent": True}) for display in DISPLAYS]
SHOWN += [(display, 1, {"colour_map": name}) for display in ("relevancy", "depth") for name in COLOUR_MAPS]


@pytest.mark.parametrize(("display", "queries", "more"), SHOWN)
def test_the_shader_composes_as_the_kernel_does(gl, display, queries, more):
    rasterizer = DrawnAlready(random_channels(queries, display, queries))
    settings = {"heat_opacity": 0.8, "dim": 0.4, "threshold": 0.55, "alpha_gate": 0.25, **more}
    request = request_for(display, queries)
    request = replace(request, camera=CAMERA.resized(50, 40), width=50)
    request = replace(request, picture=replace(request.picture, **settings))
    renderer = GlRenderer(gl, OnDevice(gl, rasterizer))
    got, expected = renderer.read(request), ArrayRenderer(rasterizer).read(request)
    renderer.release()
    assert got.shape == expected.shape == (40, 50, 4 if more.get("transparent") else 3)
    assert largest_difference(got, expected) <= 1


@pytest.mark.parametrize("display", DISPLAYS)
@pytest.mark.parametrize("split", [Split(), Split("levels")])
@pytest.mark.parametrize("selects", [False, True])
def test_the_image_is_that_of_the_reference(renderer, display, split, selects):
    """Either backend against float64 channels composed on the CPU: 2/255; pixels at a cut-off may flip."""
    request = request_for(display, split=split).seen_by(CAMERA)
    if selects:
        nothing = np.zeros(COUNT, bool)
        marks = Marks(np.arange(COUNT) % 2 == 0, nothing, nothing)
        plain, request = request, replace(request, scene=edited_scene(SCENE, marks))
        assert largest_difference(renderer.read(request), renderer.read(plain)) > 60
    got = renderer.read(request)
    assert got.shape == (CAMERA.height, CAMERA.width, 3)
    expected = ArrayRenderer(ReferenceRasterizer()).read(request)
    assert (np.abs(got.astype(int) - expected).max(-1) > 2).mean() <= 2e-3


def test_the_reference_image_is_composed_of_float64_channels():
    """Apart from the renderers: colours, depths and relevancies splatted one by one."""
    gaussians = SCENE.gaussians
    view = ReferenceRasterizer().view(gaussians, CAMERA)
    values = heats(Subject(COUNT, answers=ANSWERS[:2]))
    rgb = colours(gaussians.sh, gaussians.means, CAMERA.position)
    image, alpha = view.splat(np.concatenate([rgb, values, view.footprints.depths[:, None]], 1))
    ranges = {"relevancy": ((HEAT_BASE, 1.0),) * 2, "depth": (depth_range(gaussians, CAMERA),)}
    for display, extra in (("relevancy", image[..., 3:5]), ("depth", image[..., 5:])):
        picture = replace(PICTURE, display=display, own_colours=True)
        expected = compose(Channels(image[..., :3], alpha, extra), picture, ranges[display])
        got = ArrayRenderer(ReferenceRasterizer()).read(request_for(display))
        assert (np.abs(got.astype(int) - expected).max(-1) > 1).mean() <= 2e-3


# What is kept between requests.


@pytest.fixture
def passes(monkeypatch):
    """Notes each pass of a rasterizer."""
    made = []

    def noting(method):
        return lambda *arguments, **options: (made.append(arguments), method(*arguments, **options))[1]

    monkeypatch.setattr(GlRasterizer, "draw", noting(GlRasterizer.draw))
    monkeypatch.setattr(renderers, "splat_colours", noting(renderers.splat_colours))
    return made


def test_channels_are_kept_while_only_view_settings_change(renderer, passes):
    heat = request_for("relevancy")
    first = renderer.read(heat)
    faint = replace(heat, picture=replace(heat.picture, heat_opacity=0.1))
    assert largest_difference(first, renderer.read(faint)) > 20
    renderer.read(replace(heat, picture=replace(heat.picture, display="rgb")))
    renderer.read(replace(heat, camera=replace(CAMERA, name="same view")))
    assert len(passes) == 1
    renderer.read(heat.seen_by(random_camera(4)))
    assert len(passes) == 2
    inverse = tuple(replace(one, relevancy=1 - one.relevancy) for one in ANSWERS[:2])
    assert largest_difference(renderer.read(replace(heat, answers=inverse)), first) > 20
    renderer.read(plain_request(Scene(random_gaussians(20, 3)), CAMERA, heat.picture))
    assert len(passes) == 4


def test_reading_images_leaves_nothing_on_the_device(gl, renderer, monkeypatch):
    gc.collect()  # of other tests
    monkeypatch.setattr(gl, "gc_mode", "context_gc")  # which keeps what is dropped
    for _ in range(2):
        renderer.read(request_for())
    gc.collect()
    assert {type(dropped).__name__ for dropped in gl.objects} <= {"InvalidObject"}  # released before


def test_panes_of_one_camera_share_one_pass(renderer, passes):
    """Two or three panes drawn together are those drawn alone."""
    split = Split("wipe", second="depth", at=0.5)
    for first in ("latent", "relevancy", "rgb", "depth"):
        request = request_for(first, split=split)
        alone = [renderer.read(request_for(display)).astype(int) for display in (first, "depth")]
        renderer.read(request.seen_by(random_camera(7)))
        passes.clear()
        for _ in range(2):
            both, middle = renderer.read(request), round(0.5 * CAMERA.width)
            assert np.abs(both[:, :middle] - alone[0][:, :middle]).max() <= 1
            assert np.abs(both[:, middle:] - alone[1][:, middle:]).max() <= 1
        assert len(passes) == 1
    renderer.read(request_for("latent", split=Split("levels")).seen_by(random_camera(9)))
    assert len(passes) == 2


# Pixels: where they are, and the surface in them.


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


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="asks libGL.so.1")
def test_drawing_restores_the_gl_state(gl, renderer):
    target = gl.texture((CAMERA.width, CAMERA.height), 4)
    bound = gl.framebuffer([gl.texture((CAMERA.width, CAMERA.height), 4)])
    bound.use()
    gl.enable_only(0)
    gl.blend_func = 0x0302, 0x0303  # source alpha, 1 - source alpha
    before = gl_state()
    renderer.draw(request_for("relevancy"), [target])
    np.testing.assert_array_equal(gl_state(), before)
    gl.detect_framebuffer(0).use()
    bound.release()
    target.release()


def test_picking_finds_the_surface(renderer):
    """An opaque disc at z = 4 behind a faint one at z = 2: the surface is the opaque one."""
    solid, veil = wall((1, 1, 1), (0, 0, 4.0), 0.5), wall((0, 0, 1), (0, 0, 2.0), 0.5)
    faint = replace(veil, opacity_logits=np.array([-1.0]))
    pairs = {f.name: np.concatenate([getattr(solid, f.name), getattr(faint, f.name)]) for f in fields(solid)}
    request = plain_request(Scene(Gaussians(**pairs)), FRONT, PictureConfig())
    renderer.read(request)
    found = renderer.depth_at(request, 32.0, 24.0)
    assert found == pytest.approx(4.0, rel=1e-5)
    for beside in ((0.5, 0.5), (-1.0, 3.0), (64.0, 3.0)):
        assert renderer.depth_at(request, *beside) is None
    depths = renderer.depth_map(request)
    assert depths.shape == (FRONT.height, FRONT.width)
    assert depths[24, 32] == pytest.approx(found, rel=0.2)  # the mean on a device
    assert depths[0, 0] == 0
    alone = plain_request(Scene(faint), FRONT, PictureConfig())
    assert renderer.depth_at(alone, 32.0, 24.0) == pytest.approx(2.0, rel=1e-5)  # half is never reached


@pytest.mark.parametrize("size", [(1, 1), (7, 1), (33, 21), (70, 45)])
def test_every_size(renderer, size):
    request = plain_request(SCENE, CAMERA.resized(*size), PICTURE)
    assert renderer.read(request).shape == (size[1], size[0], 3)
    assert renderer.read(replace(request, split=Split("levels"))).shape == (size[1], 3 * size[0], 3)


# Depths: the near plane, the range of the depth display, and why nothing is seen.

SIZE = (160, 120)


def opening(scene: Scene) -> Camera:
    return default_view(scene, extent_of(scene), SIZE).camera(*SIZE)


def test_near_plane_follows_the_camera_and_clips():
    scene = blob_scene()
    assert [image_formation(scene, camera).near for camera in scene.cameras] == [scene.near] * 3
    ahead, seen = scene.cameras[0], []
    for left in (1.0, 0.15, 0.1):  # of the way to the middle
        matrix = ahead.world_to_camera.copy()
        matrix[:3, 3] *= left
        seen.append(image_formation(scene, replace(ahead, world_to_camera=matrix)).near)
    assert scene.near == seen[0] > seen[1] > seen[2] > 0
    scene = blob_scene()
    plain = image_formation(scene, SIDE)
    assert image_formation(scene, SIDE, Clip(0.01, 7.0)) == replace(plain, far=7.0)
    assert image_formation(scene, SIDE, Clip(3.0)) == replace(plain, near=3.0)
    assert (plain.far, far_plane(plain)) == (None, np.inf)
    assert image_formation(replace(scene, antialiased=True), SIDE) == replace(plain, antialiased=True)
    near, far = depth_range(scene.gaussians, SIDE, BOOK_ALONE)  # of what is left
    assert 4.4 < near < far < 5.6


def looking_away() -> Camera:
    camera = blob_scene().cameras[1]
    matrix = camera.world_to_camera.copy()
    matrix[[0, 2]] *= -1
    return replace(camera, world_to_camera=matrix)


BLOBS = blob_scene().gaussians


@pytest.mark.parametrize(
    ("gaussians", "reason"),
    [
        (BLOBS.take(np.zeros(360, bool)), "the scene holds no Gaussians"),
        (replace(BLOBS, means=np.full((360, 3), np.nan)), "none of the 360 Gaussians can be drawn"),
        (replace(BLOBS, opacity_logits=np.full(360, -20.0)), "all 360 Gaussians are transparent"),
    ],
)
def test_why_undrawable_names_the_reason(gaussians, reason):
    assert why_undrawable(gaussians).startswith(reason)
    assert why_nothing(gaussians, blob_scene().cameras[0]).startswith(reason)
    assert np.isfinite(opening(Scene(gaussians)).world_to_camera).all()


def test_why_nothing_names_the_reason():
    gaussians, camera = blob_scene().gaussians, blob_scene().cameras[1]
    assert why_undrawable(gaussians) == ""
    assert "behind the camera" in why_nothing(gaussians, looking_away())
    aside = camera.world_to_camera.copy()
    aside[0, 3] += 1e3
    reason = why_nothing(gaussians, replace(camera, world_to_camera=aside))
    assert "nothing of the scene lies in this picture" in reason


def test_an_empty_image_is_told_and_an_empty_scene_is_the_background(renderer):
    assert not renderer.shows_nothing()  # nothing was drawn yet
    for made in (renderer, ArrayRenderer(load_rasterizer("cpu"))):
        for camera, nothing in ((blob_scene().cameras[0], False), (looking_away(), True)):
            made.read(plain_request(blob_scene(), camera, PictureConfig()))
            assert made.shows_nothing() == nothing
    empty = Scene(SCENE.gaussians.take(np.zeros(COUNT, bool)))
    for display in ("rgb", "depth"):
        request = plain_request(empty, CAMERA, replace(PICTURE, display=display))
        assert np.abs(renderer.read(request) - np.round(255 * np.array(PICTURE.background))).max() <= 1
    assert renderer.depth_at(request, 3, 3) is None


# The near and the far cut.

# From the side: the blobs lie behind each other, mug, book, plant, at depths of about 3.8, 5 and 6.2.
SIDE = look_at(np.array([-5.0, 0, 0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
BOOK_ALONE = Clip(4.4, 5.6)


@pytest.mark.parametrize("display", ["rgb", "depth", "alpha"])
@pytest.mark.parametrize("clip", [BOOK_ALONE, Clip(near=4.4), Clip(far=4.4)])
def test_clipped_gaussians_are_not_drawn(renderer, display, clip):
    scene = blob_scene()
    depths = scene.gaussians.means @ SIDE.rotation[2] + SIDE.world_to_camera[2, 3]
    kept = scene.take(np.flatnonzero(clip.keeps(depths)))
    assert 0 < len(kept.gaussians) < 360
    whole = plain_request(scene, SIDE, PictureConfig(display=display))
    expected = renderer.read(plain_request(kept, SIDE, whole.picture)).astype(int)
    seen = [renderer.read(request).astype(int) for request in (whole, replace(whole, clip=clip), whole)]
    np.testing.assert_allclose(seen[1], expected, atol=1)
    assert np.abs(seen[1] - seen[0]).max() > 20
    np.testing.assert_array_equal(seen[2], seen[0])


def test_the_far_cut_is_not_nearer_than_the_near_one(opened):
    for wanted, kept in ((Clip(3.0, 2.0), Clip(3.0, 3.0)), (Clip(-1.0, 2.0), Clip(0.0, 2.0))):
        settings.set_clip(opened, wanted)
        assert opened.state.session.clip == kept


@pytest.fixture
def beside(opened):
    """Stands at `SIDE`."""
    settings.resize(opened, *SIZE)
    viewpoint.move(opened, lambda view: from_camera(SIDE, opened.state.open.extent))
    return opened


def test_an_outline_selects_nothing_that_is_clipped(beside):
    editing.use_tool(beside, "rectangle")
    settings.set_clip(beside, BOOK_ALONE)
    editing.begin_stroke(beside, 0.0, 0.0)
    editing.extend_stroke(beside, 1.0, 1.0)
    editing.end_stroke(beside)
    assert marked(beside)[0] == "book"


# Drivers.


def test_auto_takes_the_cpu_where_the_driver_is_software(gl):
    renderer = renderer_for(gl)
    assert renderer.backend == ("opengl" if renderers.suits_opengl(gl) else "cpu")
    renderer.release()


DRIVERS = """
import moderngl, sys
from langsplat_core.config import PictureConfig
from langsplat_core.errors import BackendError
from langsplat_core.scene import Scene
from langsplat_viewer.rendering.renderer import open_renderer, renderer_for
from langsplat_viewer.rendering.request import plain_request
from tests.support.scenes import random_camera, random_gaussians
request = plain_request(Scene(random_gaussians(20)), random_camera(), PictureConfig())
"""
OLD_DRIVER = """
ctx = moderngl.create_context(standalone=True, backend="egl", require=330)
assert ctx.version_code == 330, ctx.version_code
renderer = renderer_for(ctx)
print(renderer.backend, renderer.read(request).any(), ctx.error)
try:
    renderer_for(ctx, "opengl")
except BackendError as error:
    print(error)
"""
NO_DRIVER = """
for backend in ("auto", "cpu"):
    with open_renderer(backend) as renderer:
        assert renderer.read(request).any()
try:
    with open_renderer("opengl"):
        pass
except BackendError as error:
    assert "libegl1" in str(error) and "--backend cpu" in str(error) and "\\n" not in str(error)
    print("refused")
print([name for name in ("glfw", "imgui_bundle") if name in sys.modules])
"""
OLDER = {"MESA_GL_VERSION_OVERRIDE": "3.3FC", "MESA_GLSL_VERSION_OVERRIDE": "330"}


def lines_of(gl, code: str, driver: dict[str, str]) -> list[str]:
    """Two lines that a process prints with another driver."""
    if "MESA_GL_VERSION_OVERRIDE" in driver and "llvmpipe" not in gl.info["GL_RENDERER"]:
        pytest.skip("only Mesa can pretend to be an older OpenGL")
    command = [sys.executable, "-c", DRIVERS + code]
    run = subprocess.run(command, env=os.environ | driver, capture_output=True, text=True)
    return (run.stdout.splitlines() or [run.stderr, ""])[:2]


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Mesa's override")
def test_opengl_3_3_is_enough_with_the_cpu_rasterizer(gl):
    first, second = lines_of(gl, OLD_DRIVER, OLDER)
    assert first.split() == ["cpu", "True", "GL_NO_ERROR"]
    assert "needs OpenGL 4.1, this driver offers 3.3" in second


@pytest.mark.long
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="hides EGL's drivers from its loader")
@pytest.mark.parametrize(
    "driver",
    [
        {"__EGL_VENDOR_LIBRARY_FILENAMES": "/nonexistent.json"},
        {"MESA_GL_VERSION_OVERRIDE": "2.1", "MESA_GLSL_VERSION_OVERRIDE": "120"},
        OLDER,
    ],
    ids=["none", "2.1", "3.3"],
)
def test_the_cpu_draws_without_a_sufficient_driver(gl, driver):
    assert lines_of(gl, NO_DRIVER, driver) == ["refused", "[]"]
