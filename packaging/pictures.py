"""Make the README's pictures again: `make pictures`. Needs a display (or Xvfb) for the window."""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from imgui_bundle import hello_imgui, imgui  # isort: skip  (before glfw)
from imgui_bundle.immapp import testing  # isort: skip

import numpy as np
from PIL import Image

from langsplat_core.config import CodecConfig, PictureConfig
from langsplat_core.io.hostile import opened
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.training.language.codec_fit import train_autoencoder
from langsplat_viewer import disk
from langsplat_viewer.actions import editing, opening, outline, settings, viewpoint
from langsplat_viewer.options import ViewerOptions, scene_path, services
from langsplat_viewer.panels import search
from langsplat_viewer.program import draw
from langsplat_viewer.state import TrainingForm
from langsplat_viewer.window import Window

sys.path.insert(0, str(Path(__file__).parent.parent))  # the tests
from tests.support.processes import open_browser, open_tab

OUT = Path(__file__).parent.parent / "docs" / "pictures"
CAMERA = "3"
BESIDE_THE_SEARCH = "21"  # a camera that sees things where the search does not float
FRAMES = 20_000  # that something is waited for
PATIENCE = 600.0  # seconds that a picture may take
Act = Callable[[Any, Window], None]
STILLS = {
    "colours.png": [],
    "latent_whole.png": ["--display", "latent", "--level", "whole"],
    "latent_part.png": ["--display", "latent", "--level", "part"],
    "segmentation.png": [
        *("--query", "teddy bear", "--query", "blue gift", "--query", "burger"),
        *("--display", "segmentation"),
    ],
}
PAGE, PAGE_VIEW, PAGE_PHRASE = "page.jpg", 20, "blue gift"
HERO, LOOP, REAL, NOTEBOOK = "hero.jpg", "page.webp", "real.jpg", "notebook.jpg"
LOOKS: tuple[dict[str, Any], ...] = (
    {"display": "rgb"},
    {"display": "latent", "level": "whole"},
    {"query": ("teddy bear",)},
)
QUERIES = ("teddy bear", "blue gift", "hamburger")


def _found(ctx: Any, window: Window) -> None:
    settings.toggle_overlay(window.viewer, "things")
    ctx.yield_(60)
    viewpoint.zoom_by(window.viewer, 1.0001)  # the first image took long: kernels were loaded


def _under_the_cursor(ctx: Any, window: Window) -> None:
    viewpoint.toggle_pointing(window.viewer)
    ctx.mouse_teleport_to_pos((480, 430))
    for _ in range(FRAMES):
        ctx.yield_()
        hover = window.viewer.state.hover
        if hover is not None and hover.found is not None:
            return


def _selected(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.open_panel(viewer, "Selection")
    editing.select_query(viewer)
    settings.set_display(viewer, "rgb")


def _outlined(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.open_panel(viewer, "Outline")
    while viewer.state.outline is None or not viewer.state.outline.roots:
        ctx.yield_()
    named = {outline.name_of(viewer, row): row.node for row in viewer.state.outline.roots}
    things = [
        node for name, node in named.items() if name.split(" or ")[0] in ("hamburger", "laptop", "present")
    ]
    outline.hide(viewer, things[0])
    settings.set_display(viewer, "latent", 2)
    ctx.yield_(10)


def _boxed(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    editing.select_query(viewer)
    settings.open_panel(viewer, "Transform")
    editing.fill_box(viewer)
    editing.select_none(viewer)
    settings.set_display(viewer, "rgb")
    viewer.state.edit_form = replace(viewer.state.edit_form, gizmo="box")


def _noted(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.open_panel(viewer, "Notes")
    for place, text in (((0.26, 0.62), "a gift of 1987"), ((0.49, 0.14), "eaten by the children")):
        settings.pin_at(viewer, *place)
        settings.write_note(viewer, viewer.state.session.notes[-1], text)


def _beside(ctx: Any, window: Window) -> None:
    """Open the scene beside itself with the paper's autoencoder of three numbers in place of its codebook."""
    viewer, folder = window.viewer, Path(tempfile.mkdtemp())
    scene, path = viewer.state.open.scene, folder / "autoencoder.ply"
    assert scene is not None
    assert scene.language is not None
    field = scene.language
    codewords = field.codec.decode(np.arange(field.codec.size, dtype=np.uint16)[:, None])
    codec = train_autoencoder(codewords, CodecConfig("autoencoder", steps=2_000))
    latents = np.where(field.known[..., None], codec.encode(codewords)[field.latents[..., 0]], 0)
    language = replace(field, latents=latents, codec=codec, tree=None)
    save_scene(path, replace(scene, language=language, path=path))
    opening.open_beside(viewer, path)
    while viewer.beside is None or not any(viewer.beside.state.shown_results()):
        ctx.yield_()


def _transformed(ctx: Any, window: Window) -> None:
    _selected(ctx, window)
    settings.open_panel(window.viewer, "Transform")
    editing.next_gizmo(window.viewer)


def _side_by_side(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.open_panel(viewer, "Record")
    settings.compare(viewer, "wipe", "latent", 2)
    settings.toggle_overlay(viewer, "cube")
    settings.toggle_overlay(viewer, "grid")


def _palette(ctx: Any, window: Window) -> None:
    settings.toggle_palette(window.viewer)
    ctx.yield_(5)


def _light(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.prefer(viewer, theme="light")
    settings.set_picture(viewer, replace(viewer.state.session.picture, colour_map="cividis"))


def _three_levels(ctx: Any, window: Window) -> None:
    settings.turn_panel(window.viewer, search.TITLE, is_open=False)  # it lies over the first level
    settings.set_display(window.viewer, "latent")
    settings.toggle_levels(window.viewer)


def _tree(ctx: Any, window: Window) -> None:
    settings.turn_panel(window.viewer, search.TITLE, is_open=False)  # it lies over the first level
    settings.set_display(window.viewer, "tree")
    settings.toggle_levels(window.viewer)


def _overlays(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    for overlay in ("cameras", "cube", "grid"):
        settings.toggle_overlay(viewer, overlay)
    settings.set_display(viewer, "rgb")
    viewpoint.step_camera(viewer, 6)
    viewpoint.zoom_by(viewer, 2.2)
    settings.toggle_measuring(viewer)
    ctx.yield_(30)
    for place in ((0.35, 0.55), (0.6, 0.62)):
        settings.measure_at(viewer, *place)
        ctx.yield_(10)


def _orthographic(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.set_display(viewer, "rgb")
    viewpoint.toggle_orthographic(viewer)
    viewpoint.look_from(viewer, "top")
    _settled(ctx, window)
    viewpoint.zoom_by(viewer, 1.6)
    settings.toggle_overlay(viewer, "cube")
    settings.toggle_overlay(viewer, "grid")
    _settled(ctx, window)


def _film(ctx: Any, window: Window) -> None:
    viewer = window.viewer
    settings.open_panel(viewer, "Timeline")
    for _ in range(4):
        viewpoint.step_camera(viewer, 2)
        _settled(ctx, window)
        viewpoint.add_keyframe(viewer)
    viewpoint.scrub(viewer, 2.5)


def _trained(ctx: Any, window: Window) -> None:
    """Train a room of a dozen photographs until it is half done."""
    viewer, folder = window.viewer, Path(tempfile.mkdtemp())
    room = ["dataset", "--seed", "3", "--views", "12", "--out", str(folder / "room")]
    subprocess.run([sys.executable, "-m", "assets.making", *room], check=True)
    settings.open_panel(viewer, "Train")
    form = TrainingForm(str(folder / "room"), out=str(folder / "room.ply"), preset="quick")
    viewer.state.training_form = form
    opening.start_training(viewer)
    process = viewer.training
    assert process is not None
    while process.exit_code is None and len(process.progress.curves.get("psnr", [])) < 8:
        looks = disk.is_preview(viewer.state.path) or viewer.state.opening is not None
        if not looks and viewer.worker.current is None and disk.newest(process.out):
            opening.look_at_training(viewer)
        ctx.yield_()
    viewer.state.wanted_panel = "Train"
    ctx.yield_(5)


def _settled(ctx: Any, window: Window) -> None:
    """Nothing moves, and nothing works in the background."""
    ctx.yield_(60)
    while window.viewer.worker.current is not None:
        ctx.yield_()


# File -> what is searched, and what is done in the window before its picture is taken.
WINDOWS: dict[str, tuple[tuple[str, ...], Act]] = {
    "window.png": (QUERIES, _found),
    "cursor.jpg": (("teddy bear",), _under_the_cursor),
    "select.jpg": (("teddy bear",), _selected),
    "transform.jpg": (("teddy bear",), _transformed),
    "outline.jpg": (("teddy bear",), _outlined),
    "crop.jpg": (("teddy bear",), _boxed),
    "notes.jpg": (("teddy bear",), _noted),
    "beside.jpg": (("teddy bear", "toy"), _beside),
    "side_by_side.jpg": (("teddy bear",), _side_by_side),
    "palette.jpg": (QUERIES, _palette),
    "structure.jpg": (("toy, not teddy bear", "keyboard of the laptop"), _found),
    "three_levels.jpg": (("teddy bear",), _three_levels),
    "tree.jpg": (("teddy bear",), _tree),
    "light.jpg": (("teddy bear",), _light),
    "overlays.jpg": (("teddy bear",), _overlays),
    "orthographic.jpg": (("teddy bear",), _orthographic),
    "film.jpg": (("teddy bear",), _film),
    "training.jpg": (("teddy bear",), _trained),
}


def window_picture(path: Path, queries: tuple[str, ...], act: Act) -> None:
    """Write a screenshot of the window with the demo scene and answered queries."""
    options = ViewerOptions(query=queries, display="relevancy", size="1280x800", camera=BESIDE_THE_SEARCH)
    window = Window(scene_path(None), options, services(""))
    window.idles, window.toasts.seconds = False, 0.0
    whole = path.with_suffix(".whole.png")

    def wait_and_capture(ctx: Any) -> None:  # imgui's test context has no public type
        engine = imgui.test_engine.get_io(hello_imgui.get_imgui_test_engine())
        engine.config_watchdog_warning = engine.config_watchdog_kill_test = PATIENCE
        state = window.viewer.state
        for _ in range(FRAMES):
            ctx.yield_()
            queries = state.session.queries
            answered = queries and all(state.result(query) is not None for query in queries)
            if answered and window.viewer.worker.current is None:
                break
        act(ctx, window)
        ctx.yield_(30)
        points = window.viewer.state.hover is not None  # at what the picture tells of
        flags = imgui.test_engine.CaptureFlags_
        testing.capture(ctx, str(whole), flags=flags.none if points else flags.hide_mouse_cursor)

    testing.run(test_function=wait_and_capture, runner_params=window.params())
    with opened(whole) as picture:
        rgb = picture.convert("RGB")
    rgb.save(path, optimize=True, quality=88)
    whole.unlink()


@contextmanager
def open_page(size: dict[str, int], **settings: Any) -> Iterator[Any]:
    """Open the demo scene's page in a browser."""
    with tempfile.TemporaryDirectory() as folder, open_browser() as browser:
        page = Path(folder) / "room.html"
        command = [sys.executable, "-m", "langsplat_core", "export", "--quiet", "--title", "A toy table"]
        subprocess.run([*command, str(scene_path(None)), str(page)], check=True)
        with open_tab(browser, page, reduced_motion="reduce", viewport=size, **settings) as tab:
            tab.run(f"async () => (await langsplat).page.view({PAGE_VIEW})")
            yield tab


def page_picture(path: Path) -> None:
    """Write a screenshot of the demo scene's page in a browser."""
    with open_page({"width": 1280, "height": 720}) as tab:
        tab.page.fill("#phrase", PAGE_PHRASE)
        tab.page.press("#phrase", "Enter")
        tab.page.wait_for_timeout(5_000)  # until the order is found and the view rests
        tab.page.screenshot(path=path, type="jpeg", quality=85)


def notebook_picture(path: Path) -> None:
    """Write a screenshot of what a cell of a notebook has: its line, and its output."""
    shown = load_scene(scene_path(None)).show(PAGE_PHRASE)
    style = "font: 15px monospace; margin: 16px 24px; color: #555"
    line = f"[1]: &nbsp;scene.show(&quot;{PAGE_PHRASE}&quot;)"
    with tempfile.TemporaryDirectory() as folder, open_browser() as browser:
        cell = Path(folder) / "cell.html"
        cell.write_text(f'<!doctype html><body style="{style}"><p>{line}</p>{shown._repr_html_()}')
        tab = browser.new_page(viewport={"width": 1000, "height": 620}, reduced_motion="reduce")
        tab.goto(cell.as_uri())
        tab.frames[1].wait_for_function("async () => (await langsplat).page.answers.length")
        tab.wait_for_timeout(8_000)  # until the order is found
        tab.screenshot(path=path, type="jpeg", quality=85)


class Undimmed(ViewerOptions):
    """Options that leave the colours around an answer as they are."""

    @property
    def picture(self) -> PictureConfig:
        return replace(super().picture, dim=1.0)


def looks_picture(path: Path, scene: Path, looks: Sequence[dict[str, Any]], size: str, camera: str) -> None:
    """Write looks of a scene, seen by one camera, side by side."""
    with tempfile.TemporaryDirectory() as folder:
        out, images = Path(folder) / "look.png", []
        for look in looks:
            options = Undimmed(**look, headless=True, out=out, size=size, camera=camera)
            draw(options, scene, services(""))
            with opened(out) as picture:
                images.append(np.pad(np.asarray(picture.convert("RGB")), ((0, 0), (0, 6), (0, 0))))
    Image.fromarray(np.concatenate(images, 1)[:, :-6]).save(path, optimize=True, quality=90)


def hero_picture(path: Path) -> None:
    """Write colours, the latent language field and an answer of the demo scene."""
    looks_picture(path, scene_path(None), LOOKS, "640x540", CAMERA)


# Of the page, image by image: what is done before it. Every image is of the finest drawing.

REST = """async () => {
  const { page } = await langsplat;
  clearTimeout(page.rest);
  Object.assign(page, { share: 1, moving: false });
  while (!(await page.painter.sort(page.controls.camera(devicePixelRatio)))) {}
  page.paint();
}"""
ORBIT = "async ([x, y]) => (await langsplat).page.controls.orbit(x, y)"
SEARCH = "async (phrase) => (await langsplat).page.search(phrase)"
VIEW = """async (where) => {
  const { controls } = (await langsplat).page;
  where === "there" ? document.getElementById("face").click() : where && controls.go(controls.view, where);
  const { rotation, position } = controls.view;
  return [...position, ...rotation.slice(3, 9), controls.distance];
}"""
STEPS, TURNS, HELD = 9, 6, 12  # images of a flight, of a turn, of what is to be read
PACE = 90  # ms an image


def page_loop(path: Path) -> None:
    """Write an animation of the demo scene's page: phrases are typed, and what is found is flown to."""
    images: list[Image.Image] = []
    with open_page({"width": 800, "height": 450}, color_scheme="dark") as tab:

        def take(count: int = 1) -> None:
            tab.run(REST)
            with opened(tab.page.screenshot(timeout=0)) as picture:
                images.extend([picture.convert("RGB")] * count)

        def fly(start: list[float], end: list[float]) -> None:
            for step in range(1, STEPS + 1):
                share = step / STEPS
                share *= share * (3 - 2 * share)
                tab.run(VIEW, [a + share * (b - a) for a, b in zip(start, end, strict=True)])
                take()

        home = start = tab.run(VIEW)
        take(HELD)
        for phrase in ("teapot", "blue gift"):
            tab.page.fill("#phrase", "")
            for letter in phrase:
                tab.page.press("#phrase", letter)
                take()
            tab.run(SEARCH, phrase)
            take(HELD)
            there = tab.run(VIEW, "there")
            tab.run(VIEW, start)
            fly(start, there)
            for _ in range(TURNS):
                tab.run(ORBIT, [-12, 0])
                take()
            start = tab.run(VIEW)
            take(HELD)
        tab.run(SEARCH, "")
        fly(start, home)
    images[0].save(path, save_all=True, append_images=images[1:], duration=PACE, loop=0, quality=60, method=6)


OTHERS = {PAGE: page_picture, NOTEBOOK: notebook_picture, LOOP: page_loop, HERO: hero_picture}


def main() -> None:
    """Write every picture into `docs/pictures`, or those that are named; `real.jpg SCENE` of that scene."""
    OUT.mkdir(exist_ok=True)
    if sys.argv[1:2] == [REAL]:
        looks_picture(OUT / REAL, Path(sys.argv[2]), LOOKS[:2], "640x426", "4")
        return
    wanted = sys.argv[1:] or [*OTHERS, *STILLS, *WINDOWS]
    if len(wanted) > 1:  # one a process: imgui's test engine runs once
        for name in wanted:
            subprocess.run([sys.executable, __file__, name], check=True)
    elif wanted[0] in OTHERS:
        OTHERS[wanted[0]](OUT / wanted[0])
    elif wanted[0] in STILLS:
        command = [sys.executable, "-m", "langsplat_viewer", "--headless", "--camera", CAMERA]
        subprocess.run([*command, "--out", str(OUT / wanted[0]), *STILLS[wanted[0]]], check=True)
    else:
        window_picture(OUT / wanted[0], *WINDOWS[wanted[0]])


if __name__ == "__main__":
    main()
