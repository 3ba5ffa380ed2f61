"""Exported pages in a real browser: images as the OpenGL backend's, answers as Python's, hostile scenes."""

import itertools
import json
import re
import zlib
from collections.abc import Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import Array, psnr, unit
from langsplat_core.cli.app import parse
from langsplat_core.cli.export import Export
from langsplat_core.config import PictureConfig
from langsplat_core.display.composing import compose
from langsplat_core.display.displays import DISPLAYS, Channels, Subject, heats
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io.files import write_whole
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.pipeline.webpage import covered, make_page, views
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.opengl.rasterizer import GlRasterizer
from langsplat_core.raster.render import render, splat_colours, view_of
from langsplat_core.scene import LEVELS, Camera, Gaussians, Scene
from langsplat_core.semantics.encoders import load_text_encoder
from tests.support.backends import Measure
from tests.support.fakes import Fluent
from tests.support.file_samples import random_field
from tests.support.processes import Tab, open_browser, open_tab
from tests.support.scenes import DEMO, random_camera, random_gaussians

pytestmark = pytest.mark.long

THINGS = """teddy bear,laptop,hamburger,candle,rocket,teapot,toy duck,penguin,ball,sofa,table,chair,present,
fruit basket,aeroplane,snail,car,painting,rug,potted plant,stool,floor,wall,apple,orange,mug,lamp,guitar,
umbrella,hat,train,robot,cactus,castle,drum,headphones,fish,flag,clock,camera,backpack,shoe,windmill,snowman,globe"""
PARTS = "keyboard,handle,wheel,screen,leg,spout,lid,wing,propeller,ear,nose,flame,bow,bun,seat,cushion"
NAMES = [name.strip() for name in f"{THINGS},{PARTS}".split(",")]
MIXED = [f"{colour} {thing}" for colour in ("red", "blue", "yellow") for thing in NAMES[:10]]
OWNED = ["duck beak", "teapot lid", "laptop screen", "the Red Mug!", "  blue, gift ", "penguin’s beak"]
PHRASES = [*NAMES, *MIXED, *OWNED, "table keyboard", "wooden table", "green car"]
MARKUP = '<img src=x onerror="window.escaped=1"></script><script>window.escaped=2</script>'
FIELDS = ("level", "scores", "fits", "peak", "probability", "found", "verdict", "place", "box")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with open_browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def demo() -> Scene:
    scene, calibration = load_scene(DEMO), load_text_encoder("demo").calibration  # which is newer
    return replace(scene, language=replace(scene.language, calibration=calibration))


@pytest.fixture(scope="module")
def engine(demo: Scene) -> QueryEngine:
    return QueryEngine(demo, load_text_encoder)


@pytest.fixture(scope="module")
def page(demo: Scene, engine: QueryEngine, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "room.html"
    write_whole(path, make_page(demo, engine, "Demo")[0])
    return path


@pytest.fixture(scope="module")
def thin(demo: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of every eighth Gaussian, for what is not about the image: here the processor draws it."""
    scene = demo.take(np.arange(0, len(demo.gaussians), 8))
    path = tmp_path_factory.mktemp("page") / "thin.html"
    write_whole(path, make_page(scene, QueryEngine(scene, load_text_encoder), "Thin")[0])
    return path


@pytest.fixture(scope="module")
def tab(browser: Any, page: Path) -> Iterator[Tab]:
    with open_tab(browser, page) as opened:
        yield opened


def exported(tmp_path: Path, scene: Scene, engine: QueryEngine | None = None) -> Path:
    write_whole(tmp_path / "a.html", make_page(scene, engine, "A")[0])
    return tmp_path / "a.html"


def drawn(
    gl: moderngl.Context, scene: Scene, camera: Camera, values: Array | None = None, **look: Any
) -> Array:
    """Return (H, W, 3) uint8 of the OpenGL backend."""
    rasterizer = GlRasterizer(gl, "single")
    image = splat_colours(view_of(scene, camera, rasterizer), scene.gaussians, values)
    rasterizer.release()
    channels = Channels(image.colours, image.alpha, None if values is None else image.values)
    return compose(channels, PictureConfig(display=look.pop("display", "rgb")), **look)


def compare(measured: Measure, what: str, ours: Array, theirs: Array) -> None:
    """At least 50 dB, and no value further off than 4 of 255 but for one in a thousand."""
    error = np.abs(ours.astype(int) - theirs)
    measured(what, "least dB", -psnr(ours / 255, theirs / 255))
    measured(what, "99.9 % of the differences, of 255", np.quantile(error, 0.999))
    assert theirs.std() > 5  # there is something to be seen
    assert psnr(ours / 255, theirs / 255) >= 50
    assert np.quantile(error, 0.999) <= 4


@pytest.mark.parametrize(("view", "size"), [(0, 1), (11, 1.5), (30, 0.5)])
def test_page_draws_the_bundled_scene_as_opengl_does(tab, demo, gl, measured, view, size):
    """At the photographs' size, in a larger image and in a smaller one, which dilate by other amounts."""
    camera = demo.cameras[view]
    camera = camera.resized(round(size * camera.width), round(size * camera.height))
    ours = tab.image(camera, demo.bounds()[0])
    compare(measured, "demo, colours", ours, drawn(gl, demo, camera))


def test_page_draws_heat_and_latents_as_opengl_does(tab, demo, engine, gl, measured):
    camera, origin = demo.cameras[3], demo.bounds()[0]
    answer = engine.run("teddy bear")
    ours = tab.image(camera, origin, "relevancy", "teddy bear")
    values = heats(Subject(len(demo.gaussians), answers=[answer]))
    ranges = DISPLAYS["relevancy"].ranges([answer])
    compare(measured, "demo, heat", ours, drawn(gl, demo, camera, values, display="relevancy", ranges=ranges))
    ours = tab.image(camera, origin, "latent")
    theirs = drawn(gl, demo, camera, demo.language.colours[2], display="latent")
    compare(measured, "demo, latent", ours, theirs)


def hard(kind: str) -> Gaussians:
    rng = np.random.default_rng(5)
    if kind.startswith("degree"):
        gaussians = random_gaussians(600, 3, sh_degree=int(kind[-1]))
        return replace(gaussians, sh=gaussians.sh * np.float32(0.6))
    gaussians = random_gaussians(600, 4)
    if kind == "one":
        return replace(gaussians.take(np.arange(1)), opacity_logits=np.full(1, 9.0))
    if kind == "flat and needles":
        scales = gaussians.log_scales.copy()
        scales[::2, 0], scales[1::4, 1] = -np.inf, -9
        return replace(gaussians, log_scales=scales)
    if kind == "right angles":
        quats = np.eye(4)[rng.integers(4, size=600)] + np.eye(4)[rng.integers(4, size=600)]
        return replace(gaussians, quats_wxyz=quats * rng.choice([-3, 1], (600, 1)))
    if kind == "far away":
        return replace(gaussians, means=gaussians.means + np.float32([4096, -2048, 512]))
    broken = gaussians.means.copy()  # "broken rows"
    broken[::5] = np.nan
    logits = np.where(np.arange(600) % 3, np.inf, gaussians.opacity_logits)
    return replace(gaussians, means=broken, opacity_logits=np.where(np.arange(600) % 7, logits, -np.inf))


OTHERS = "one", "flat and needles", "right angles", "far away", "broken rows"


@pytest.mark.parametrize("kind", [*(f"degree {degree}" for degree in range(4)), *OTHERS])
def test_page_draws_hard_scenes_as_opengl_does(browser, gl, measured, tmp_path, kind):
    scene = Scene(hard(kind), antialiased=kind == "degree 1")
    framed = Scene(random_gaussians(600, 4)) if kind == "one" else scene
    camera = framed.framing_camera((320, 240))
    with open_tab(browser, exported(tmp_path, scene)) as tab:
        ours = tab.image(camera, scene.bounds()[0])
        assert tab.run("async () => (await langsplat).page.language") is None
    compare(measured, "hard scenes", ours, drawn(gl, scene, camera))


def same(found: dict[str, Any], expected: Any, members: int) -> None:
    for name in FIELDS:
        value = getattr(expected, name)
        if name in ("level", "found", "verdict") or value is None:
            assert found[name] == value, name
        else:
            np.testing.assert_allclose(found[name], np.ravel(value), atol=1e-3, rtol=0, err_msg=name)
    assert found["reached"] == expected.judgement.reached
    assert found["by_chance"] == pytest.approx(expected.judgement.by_chance, abs=1e-3)
    np.testing.assert_allclose(found["margin"], expected.judgement.margin, atol=1e-2)
    np.testing.assert_allclose(found["heat"], expected.heat_range, atol=1e-3)
    assert abs(found["members"] - members) <= 1e-3 * members


def test_page_answers_100_phrases_as_python_does(tab: Tab, engine: QueryEngine, measured: Measure) -> None:
    assert len(set(PHRASES)) == 100
    verdicts = set()
    visible = engine.scene.gaussians.opacity_logits >= -np.log(254)
    for number, phrase in enumerate(PHRASES):
        level = ("auto", "auto", *LEVELS)[number % 5]
        expected, found = engine.run(phrase, level), tab.ask(phrase, level)
        same(found, expected, int(expected.members[visible].sum()))
        assert abs(found["mean"] - expected.relevancy[expected.level][visible].mean()) < 1e-3
        off = np.abs(np.subtract(found["scores"], expected.scores)).max()
        measured("answers", "difference of scores", off)
        verdicts.add(expected.verdict)
    assert verdicts == {"found", "weak match", "not here"}


RELATED = """teddy bear on the table,penguin near the rocket,laptop below the table,rug under the table,
rocket left of the teddy bear,candle right of the teddy bear,biggest toy,nearest toy,highest painting,
toy nearest to the laptop,toy without the penguin,duck beak,lid of the teapot,teapot's spout,
handle of the teapot near the laptop,toy on the left,two presents,one teapot,the two toys on the table,9 toys,
teapot without lid without spout,three leaves,two legs of the chair,two toys not penguin,
two pictures on the wall,nearest toy to the laptop,the closest toy from the sofa,biggest two toys,
two biggest toys,9 biggest toys,two toys on the left,nearest two toys to the laptop,cup of tea,
toy not penguin not teddy bear,picture of a boat on the wall,orange or apple,
nearest toy near to the biggest toy,teapot and lid of the teapot,candle and banana,the bear's hat,
9 toys or teddy bear,toy without penguin and teddy bear,lid of the teapot or candle,
toy and painting but not the penguin,the penguin's candle,where is the teapot,show me the biggest toy,
lid on the table,handle near the teapot,leaf near the laptop,leg below the table,lid above the table,
with handle"""


SPENT = """async (phrases) => {
  const { page } = await langsplat;
  return phrases.map((phrase) => {
    const began = performance.now();
    page.take(phrase);
    return performance.now() - began;
  });
}"""


def test_page_reads_phrases_with_structure_as_python_does(tab, engine, measured):
    same_reading(tab, engine, RELATED)
    for what, phrases in (("a phrase", PHRASES), ("with structure", RELATED.replace("\n", "").split(","))):
        measured(what, "slowest to its heat map, ms", max(tab.run(SPENT, phrases)))
    tab.run(SPENT, [""])


def same_reading(tab: Tab, engine: QueryEngine, phrases: str) -> None:
    visible = engine.scene.gaussians.opacity_logits >= -np.log(254)
    for phrase in phrases.replace("\n", "").split(","):
        expected = run_phrase(engine, phrase, viewpoint=engine.scene.cameras[0]).answer
        found, judged = tab.ask(phrase, whole=False), expected.judgement
        assert (found["verdict"], found["level"]) == (expected.verdict, expected.level), phrase
        for name in ("reached", "probability", "by_chance"):
            assert found[name] == pytest.approx(getattr(judged, name), abs=1e-3), (phrase, name)
        count = int((expected.members & visible).sum())  # there without what lies off the surface
        assert count <= found["members"] <= 1.12 * count, phrase


def test_several_phrases_are_answered_side_by_side(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin) as tab:
        lines = {"teddy bear, banana; candle": 3, "candle and teapot": 1, "red and blue ball": 1}
        for line, count in (lines | {"toy, other than the penguin": 1, "not the penguin": 0}).items():
            tab.run("async (line) => (await langsplat).page.search(line)", line)
            assert tab.run("async () => (await langsplat).page.answers.length") == count
            assert tab.page.locator("#map").is_disabled() == (count > 1)
        assert tab.page.inner_text("#verdict").startswith("Type what to look for")  # not only what not
        tab.run("async () => (await langsplat).page.search('teddy bear, duck, candle, laptop')")
        assert tab.page.inner_text("#verdict").endswith("not asked: laptop")
        tab.page.fill("#phrase", "table, teddy bera on the tabl")  # whole words are replaced
        for _ in range(2):
            tab.page.press("#phrase", "Enter")
            tab.page.click("#verdict button")  # did you mean
        assert tab.page.input_value("#phrase") == "table, teddy bear on the table"
        assert tab.page.inner_text("#verdict").startswith("● table: found")
        marks = tab.page.locator("#marks")
        assert tab.page.get_attribute("#phrase", "placeholder") != "what to look for"  # what is here
        for phrase, visible in (("teddy bear", True), ("banana", False), ("teddy bear", True), ("", False)):
            tab.run(f"async () => (await langsplat).page.search({phrase!r})")
            tab.page.wait_for_timeout(100)
            assert marks.is_visible() == visible, phrase
        assert tab.faults == []


def no_encoder(name: str) -> Any:
    raise EncoderError("none here")


def without_encoder(demo: Scene, **field: Any) -> tuple[Scene, QueryEngine]:
    """The bundled scene with an encoder that is not here, and no calibration."""
    own = replace(demo.language, calibration=None, encoder_id="elsewhere", **field)
    scene = replace(demo, language=own, metres_per_unit=2.0)
    return scene, QueryEngine(scene, no_encoder)


def test_page_without_encoder_answers_phrasebook_and_taught_words(browser, demo, engine, tmp_path):
    book = dict(zip(PHRASES[:60], engine.texts.of(PHRASES[:60]), strict=True))
    book["duck sœur"] = engine.texts.of(["duck"])[0]  # a quoted word of other letters is no possessive
    book["red not laptop"] = book["laptop"]
    word = QueryEngine(demo).teach("bruno", engine.run("teddy bear").members)
    words = word, replace(word, name="bear of anna")
    scene, other = without_encoder(demo, phrasebook=book, taught=words)
    assert other.calibration is None
    visible = scene.gaussians.opacity_logits >= -np.log(254)
    with open_tab(browser, exported(tmp_path, scene, other)) as tab:
        for number, phrase in enumerate((*PHRASES[:60], "bruno", "Bruno")):
            level = ("auto", *LEVELS)[number % 4] if number < 61 else "auto"
            expected = other.run(phrase, level)
            same(tab.ask(phrase, level), expected, int(expected.members[visible].sum()))
        same_reading(tab, other, "lid of the teapot,nose of bruno,laptop and bear of anna,two brunos")
        same_reading(tab, other, "duck 'sœur',laptop not red not laptop")
        tab.run("async () => (await langsplat).page.search('bruno')")
        place = " ".join(f"{2 * length:.2f}" for length in tab.ask("bruno")["place"])
        assert f"at {place} m" in tab.page.inner_text("#verdict").replace("\xa0", " ")
        tab.page.fill("#phrase", "zebra")
        tab.page.press("#phrase", "Enter")
        assert "zebra" in tab.page.inner_text("#verdict")
        assert tab.page.locator("#answer").is_hidden()
        tab.page.fill("#phrase", "Bruno, teddy  baer")  # two spaces
        tab.page.press("#phrase", "Enter")
        assert tab.page.inner_text("#verdict").endswith("Did you mean “bruno, teddy bear”?")


def test_page_without_small_encoder_knows_encoded_phrases(browser: Any, demo: Scene, tmp_path: Path) -> None:
    scene = demo.take(np.arange(0, len(demo.gaussians), 8))
    encoder = Fluent(scene.language.canonical)
    engine = QueryEngine(scene, lambda name: encoder)
    text, report = make_page(scene, engine, "A")
    write_whole(tmp_path / "a.html", text)
    assert (report.free_text, report.why_not, report.phrases > 2000) == (False, "", True)
    with open_tab(browser, tmp_path / "a.html") as tab:
        assert tab.run("async () => (await langsplat).page.language.keys.size") == report.phrases
        assert tab.ask("teddy bear")["verdict"] == engine.run("teddy bear").verdict


def test_markup_in_names_is_shown_as_text(browser, demo, engine, tmp_path):
    name = MARKUP.replace(",", "")[:80]
    word = replace(QueryEngine(demo).teach("bruno", engine.run("teddy bear").members), name=name)
    vector = engine.texts.of(["laptop"])[0]
    scene, other = without_encoder(demo, phrasebook={MARKUP: vector, "laptop": vector}, taught=(word,))
    scene = replace(scene, cameras=tuple(replace(camera, name=MARKUP) for camera in demo.cameras[:3]))
    path = tmp_path / "a.html"
    first, notes = [replace(demo.cameras[4], name="here")], [(MARKUP, (0.0, 0.0, 0.0))]
    text, _ = make_page(scene, other, MARKUP + "{{DATA}}{{SCRIPT}}", first=first, notes=notes)
    write_whole(path, text)
    with open_tab(browser, path) as tab:
        assert tab.page.title() == MARKUP + "{{DATA}}{{SCRIPT}}"
        assert MARKUP in tab.page.inner_text("h1")
        assert tab.page.locator("#views option").all_inner_texts() == ["here", *[MARKUP] * 3]
        assert tab.page.locator("#marks").is_visible()  # the note
        for phrase in (MARKUP, name):
            assert tab.run("(phrase) => [...list.options].some(({ value }) => value === phrase)", phrase)
            tab.page.fill("#phrase", phrase)
            tab.page.press("#phrase", "Enter")
        assert tab.page.locator("img").count() == 1  # that of the first view
        assert tab.page.locator("script").count() == 1  # the data's is gone once it is read
        # Should text ever become markup, the page's policy still runs none of it and fetches nothing.
        tab.run("markup => document.body.insertAdjacentHTML('beforeend', markup)", MARKUP)
        said = tab.run("() => fetch('https://example.org/').then(() => 'there', () => 'refused')")
        assert said == "refused"
        tab.page.wait_for_timeout(100)
        assert tab.run("() => window.escaped") is None
        assert {url.split(":")[0] for url in tab.requests} <= {"file", "blob"}
        assert tab.faults == []


def test_page_is_small_and_requests_nothing(browser: Any, page: Path, tmp_path: Path) -> None:
    assert page.stat().st_size < 8e6
    assert re.findall(r"https?://[^\s\"'`]+", page.read_text(encoding="utf-8").split('id="data">')[0]) == []
    alone = tmp_path / "alone.html"
    alone.write_bytes(page.read_bytes())
    with open_tab(browser, alone) as tab:
        tab.page.fill("#phrase", "laptop")
        tab.page.press("#phrase", "Enter")
        assert tab.page.inner_text("#verdict").startswith("found")
        assert [url for url in tab.requests if not url.startswith("blob:")] == [alone.as_uri()]
        assert tab.faults == []


STATE = """async () => {
  const { page } = await langsplat, { view } = page.controls;
  return { display: page.display, current: page.current, rotation: view.rotation, position: view.position };
}"""


def test_keyboard_alone_searches_and_moves(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin, reduced_motion="reduce", viewport={"width": 800, "height": 600}) as tab:
        keys = tab.page.keyboard
        reached = []
        for _ in range(20):
            keys.press("Tab")
            reached.append(tab.run("() => document.activeElement.id || document.activeElement.name"))
        wanted = ["scene", "phrase", "levels", "displays", "boxes", "before", "views", "after"]
        assert [name for name in reached if name in wanted][: len(wanted)] == wanted
        keys.press("/")
        keys.type("teddy bear")
        keys.press("Enter")
        assert tab.page.inner_text("#verdict").startswith("found")
        assert tab.run(STATE)["display"] == "relevancy"
        before = tab.run(STATE)
        tab.page.focus("#levels [value=auto]")
        keys.press("ArrowRight")  # the next of them
        assert tab.page.locator("#levels [value=subpart]").is_checked()
        assert tab.run(STATE)["rotation"] == before["rotation"]
        tab.run("() => document.activeElement.blur()")  # as when the page is opened
        keys.press("ArrowLeft")
        assert tab.run(STATE)["rotation"] != before["rotation"]
        keys.press("Shift+ArrowLeft")
        keys.press("+")
        turned = tab.run(STATE)
        keys.down("w")
        while tab.run(STATE)["position"] == turned["position"]:
            tab.page.wait_for_timeout(20)
        keys.up("W")  # with shift, or after caps lock
        assert tab.run("async () => (await langsplat).page.controls.held.size") == 0
        flown = np.subtract(tab.run(STATE)["position"], turned["position"])
        np.testing.assert_allclose(unit(flown), turned["rotation"][6:], atol=1e-6)  # ahead
        np.testing.assert_allclose(np.linalg.det(np.reshape(turned["rotation"], (3, 3))), 1, atol=1e-9)
        for key, display in (("l", "latent"), ("f", "segmentation"), ("c", "rgb")):
            keys.press(key)
            assert tab.run(STATE)["display"] == display
        keys.press("3")
        assert tab.page.locator("#levels [value=whole]").is_checked()
        keys.press("]")  # at once, since less motion is wanted
        assert tab.run(STATE)["current"] == 1
        there = tab.run("async () => (await langsplat).page.meta.views[1].position")
        assert tab.run(STATE)["position"] == there
        assert tab.faults == []


def test_mouse_and_touch_move_the_camera(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin, has_touch=True, viewport={"width": 390, "height": 800}) as tab:
        tab.page.wait_for_timeout(50)
        states = [tab.run(STATE)]
        mouse = tab.page.mouse
        for button in ("left", "right"):
            mouse.move(150, 150)
            mouse.down(button=button)
            mouse.move(190, 160, steps=3)
            mouse.up(button=button)
            states.append(tab.run(STATE))
        mouse.wheel(0, -200)
        tab.page.wait_for_timeout(100)
        states.append(tab.run(STATE))
        tab.run(
            """() => {
              const scene = document.getElementById("scene");
              const send = (type, pointerId, clientX) => scene.dispatchEvent(
                new PointerEvent(type, { pointerId, clientX, clientY: 200, pointerType: "touch" }));
              scene.setPointerCapture = () => {};
              send("pointerdown", 11, 100); send("pointerdown", 12, 200); send("pointermove", 12, 300);
              send("pointerup", 11, 100); send("pointerup", 12, 300);
            }"""
        )
        states.append(tab.run(STATE))
        orbited, panned, zoomed, pinched = states[1:]
        assert orbited["rotation"] != states[0]["rotation"]
        assert panned["rotation"] == orbited["rotation"] == zoomed["rotation"] == pinched["rotation"]
        assert len({tuple(state["position"]) for state in states}) == 5
        axes = np.reshape(orbited["rotation"], (3, 3))  # right, down, ahead
        places = [np.array(state["position"]) for state in states[1:]]
        dragged, by_fingers = axes @ (places[1] - places[0]), axes @ (places[3] - places[2])
        assert dragged[0] < 0  # the camera moves left: the scene follows the pointer
        np.testing.assert_allclose(dragged, [dragged[0], dragged[0] / 4, 0], atol=1e-6)
        assert by_fingers[0] < 0
        assert tab.run("() => document.documentElement.scrollWidth") <= 390
        assert tab.faults == []


SLOW_PAINTER = """async () => {
  const { page } = await langsplat;
  const paint = page.painter.paint.bind(page.painter);
  const full = page.controls.camera(devicePixelRatio).width;
  globalThis.widths = [], globalThis.drawn = [], globalThis.moving = [];
  page.painter.paint = (camera, appearance) => {
    moving.push(page.moving);
    const began = performance.now();
    paint(camera, appearance);
    while (performance.now() - began < 500 * (camera.width / full) ** 2);
    widths.push(camera.width / full);
    drawn.push(page.painter.drawn);
  };
}"""


def test_page_draws_coarsely_however_slow_it_is(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin, viewport={"width": 390, "height": 800}) as tab:
        tab.page.locator("#still").wait_for(state="hidden")
        tab.run(SLOW_PAINTER)
        tab.page.mouse.move(150, 150)
        tab.page.mouse.down()
        for step in range(12):
            tab.page.mouse.move(155 + 5 * step, 160)
        tab.page.mouse.up()
        tab.page.wait_for_function("() => widths.length > 2 && widths.at(-1) === 1")  # once it rests
        widths, moving = tab.run("() => [widths, moving]")
        assert min(widths) < 0.5
        tab.page.wait_for_function("() => drawn.at(-1) > 2 * Math.min(...drawn)")  # the large ones first
        full = [width == 1 and moves for width, moves in zip(widths, moving, strict=True)]
        assert not any(first and second for first, second in itertools.pairwise(full))


@pytest.mark.parametrize("size", [(390, 844), (844, 390), (1280, 720)])
def test_panel_folds_and_leaves_room_for_the_scene(browser: Any, thin: Path, size: tuple[int, int]) -> None:
    width, height = size
    with open_tab(browser, thin, viewport={"width": width, "height": height}) as tab:
        tab.run("async () => (await langsplat).page.search('teddy bear')")
        panel, button = tab.page.locator("#panel"), tab.page.locator("#fold")
        heights = []
        for opened in ("true", "false", "true"):
            assert button.get_attribute("aria-expanded") == opened
            assert tab.page.locator("#phrase").is_visible()
            box = panel.bounding_box()
            assert box["y"] >= 0
            assert box["y"] + box["height"] <= height
            assert box["width"] < 0.5 * width or box["y"] >= 0.6 * height - 8  # a sheet from below
            heights.append(box["height"])
            button.click()
        assert heights[1] < 150
        assert heights[0] == heights[2] > 150


STARTED = """globalThis.said = [];
const seen = () => said.push([document.getElementById("loading")?.textContent ?? "", document.images.length]);
new MutationObserver(seen).observe(document, { subtree: true, childList: true, characterData: true });"""
WITHOUT_GL = "HTMLCanvasElement.prototype.getContext = () => null"


@pytest.mark.parametrize("missing", ["JavaScript", "WebGL 2"])
def test_page_shows_a_picture_and_what_to_do_without(browser: Any, thin: Path, missing: str) -> None:
    context = browser.new_context(offline=True, java_script_enabled=missing != "JavaScript")
    context.add_init_script(WITHOUT_GL)
    page = context.new_page()
    page.goto(thin.as_uri())
    page.locator("#help").wait_for(state="visible")
    assert missing in page.inner_text("#welcome")
    assert page.locator("#panel").is_hidden()
    seen = np.asarray(Image.open(BytesIO(page.locator("#still").screenshot())).convert("RGB"))
    assert seen.std() > 20
    context.close()


def test_page_says_how_much_is_unpacked_before_its_first_image(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin, STARTED) as tab:
        said = tab.run("() => said")
        shares = [int(found[1]) for text, _ in said if (found := re.search(r"(\d+) %", text))]
        assert shares == sorted(shares)
        assert shares[-1] == 100
        assert all(pictures == 1 for text, pictures in said if "%" in text)
        said = "async () => { const { page } = await langsplat; page.view(1); return location.hash; }"
        assert tab.run(said) == "#view=1"  # where the camera goes, not where it is on its way
        tab.page.locator("#still").wait_for(state="hidden")


def test_address_opens_exactly_what_is_shown(browser: Any, thin: Path) -> None:
    ask = "async (phrase) => (await langsplat).page.search(phrase)"
    with open_tab(browser, thin, reduced_motion="reduce", viewport={"width": 320, "height": 240}) as tab:
        assert "#" not in tab.page.url
        tab.page.keyboard.press("]")
        tab.run(ask, "toy duck & <b>")
        tab.run(ask, "teddy bear")
        tab.page.keyboard.press("f")
        tab.page.focus("#scene")
        tab.page.keyboard.press("ArrowLeft")
        tab.page.wait_for_function("() => location.hash.includes('at=')")
        link, shown = tab.page.url, tab.run(STATE)
        tab.page.go_back()
        tab.page.locator("#displays [value=relevancy]:checked").wait_for(state="attached")
        tab.page.go_back()
        tab.page.wait_for_function("() => document.getElementById('phrase').value === 'toy duck & <b>'")
        tab.page.go_forward()
        tab.page.wait_for_function("() => document.getElementById('phrase').value === 'teddy bear'")
        hostile = "#view=99&show=__proto__&level=constructor&at=1,2,NaN,1,1,1,1,1,1,1e999&phrase=%00%FF"
        for address, expected in ((link, shown), (thin.as_uri() + hostile, None), (link, shown)):
            tab.page.goto("about:blank")
            tab.page.goto(address)
            state = tab.run(STATE)
            if expected is not None:
                assert (state["display"], state["current"]) == ("segmentation", 1)
                assert tab.page.inner_text("#verdict").startswith("found")
                np.testing.assert_allclose(state["position"], shown["position"], rtol=1e-5, atol=1e-6)
                np.testing.assert_allclose(state["rotation"], shown["rotation"], atol=1e-5)
            else:
                assert (state["display"], state["current"]) == ("rgb", 0)
        assert tab.faults == []


# A headset as a browser offers it: `read` draws two eyes, W x H each, side by side.
W, H = 160, 120
FAKE_HEADSET = """(() => {
  const [W, H] = [160, 120];
  const device = globalThis.device = Object.assign(new EventTarget(), {
    updateRenderState({ baseLayer }) { device.layer = baseLayer; },
    refuses: "no rights",
    requestReferenceSpace: async () => ({}),
    requestAnimationFrame(draw) { device.waiting = draw; },
    end: async () => device.dispatchEvent(new Event("end")),
    async read(now, matrix, eyes, ...sticks) {
      const { gl, framebuffer } = device.layer;
      device.inputSources = sticks.map(([handedness, ...axes]) => ({ handedness, gamepad: { axes } }));
      const views = eyes.map(([matrix, projectionMatrix], eye) =>
        ({ transform: { matrix }, projectionMatrix, eye }));
      for (const again of [0, 1]) {
        device.waiting(now, { getViewerPose: () => matrix && { transform: { matrix }, views } });
        await (await langsplat).page.painter.last; // the order of the Gaussians
      }
      const bytes = new Uint8Array(8 * W * H);
      gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
      gl.readPixels(0, 0, 2 * W, H, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
      return Array.from(bytes);
    },
  });
  globalThis.XRWebGLLayer = class {
    constructor(session, gl) {
      this.framebuffer = gl.createFramebuffer(this.gl = gl);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
      gl.bindRenderbuffer(gl.RENDERBUFFER, gl.createRenderbuffer());
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, 2 * W, H);
      const colours = gl.getParameter(gl.RENDERBUFFER_BINDING);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, colours);
    }
    getViewport({ eye }) { return { x: eye * W, y: 0, width: W, height: H }; }
  };
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
  const isSessionSupported = async (mode) => mode === "immersive-vr";
  const requestSession = async () => { if (device.refuses) throw Error(device.refuses); return device; };
  Object.defineProperty(navigator, "xr", { value: { isSessionSupported, requestSession } });
})();"""
REDRAWS = "async () => { const { page } = await langsplat; page.redraw(); return Boolean(page.asked); }"


def rigid(turn: Any = ((1, 0, 0), (0, 1, 0), (0, 0, 1)), by: Any = (0, 0, 0)) -> Array:
    return np.vstack([np.column_stack([turn, by]), np.eye(4)[3]])


@pytest.mark.parametrize("metres", [None, 1.25])
def test_headset_sees_the_scene_with_both_eyes(browser, demo, gl, measured, tmp_path, metres):
    """By a fake device: refused, then before and after its sticks were pushed, then left."""
    scene = replace(demo.take(np.arange(0, len(demo.gaussians), 16)), metres_per_unit=metres)
    head = rigid([[0.8, 0, 0.6], [0.168, 0.96, -0.224], [-0.576, 0.28, 0.768]], (0.3, 0.1, 0.2))
    eyes, cameras = [], []
    for side, left, right in ((-0.032, 1.1, 0.8), (0.032, 0.8, 1.1)):  # tangents of what is seen
        width, height, up, down = left + right, 1.9, 0.9, 1.0
        slopes = [(right - left) / width, (up - down) / height]
        eye = head @ rigid(by=(side, 0, 0))
        lens = [2 / width, 0, 0, 0, 0, 2 / height, 0, 0, *slopes, -1, -1, 0, 0, -0.2, 0]
        eyes.append([eye.T.ravel().tolist(), lens])
        cameras.append((eye, (W / width, H / height, W * left / width, H * up / height)))
    with open_tab(browser, exported(tmp_path, scene), FAKE_HEADSET) as tab:

        def seen(now: float, *sticks: Any, tracked: bool = True) -> Array:
            given = [now, head.T.ravel().tolist() if tracked else None, eyes, *sticks]
            return np.reshape(tab.run("(given) => device.read(...given)", given), (H, 2 * W, 4))[::-1, :, :3]

        def compare_eyes(image: Array, to_scene: Array) -> None:
            for own, (eye, lens) in zip(np.split(image, 2, axis=1), cameras, strict=True):
                rotation = np.diag([1, -1, -1]) @ unit((to_scene @ eye)[:3, :3].T)
                camera = Camera(W, H, *lens, rigid(rotation, -rotation @ (to_scene @ eye)[:3, 3]))
                compare(measured, "headset", own, drawn(gl, scene, camera))

        tab.page.click("#headset")
        tab.page.locator("#verdict", has_text="no rights").wait_for()
        tab.run("() => { device.refuses = ''; }")
        tab.page.click("#headset")
        tab.page.wait_for_function("() => device.waiting")
        seen(0, tracked=False)
        first, up = scene.cameras[0], scene.up()
        right = unit(np.cross(first.rotation[2], up))
        scale = metres or 1.5 / tab.run("async () => (await langsplat).page.controls.distance")
        to_scene = rigid(np.column_stack([right, up, np.cross(right, up)]) / scale, first.position)
        compare_eyes(seen(100), to_scene)
        seen(200, ["left", 0, 0, 0, -1])
        turned = rigid([[3**0.5 / 2, 0, -0.5], [0, 1, 0], [0.5, 0, 3**0.5 / 2]])
        middle = rigid(by=head[:3, 3])
        to_scene = to_scene @ rigid(by=-0.15 * head[:3, 2]) @ middle @ turned @ np.linalg.inv(middle)
        compare_eyes(seen(300, ["right", 0, 0, 1, 0]), to_scene)
        assert not tab.run(REDRAWS)
        tab.page.click("#headset")
        assert tab.run(REDRAWS)
        assert tab.faults == []


# An image in a PDF: its sides on the page.
PLACED = rb"(?<![\d.])(\d\d+[\d.]*) 0 0 -([\d.]+) [\d.]+ [\d.]+ cm\n(?:.*\n){,3}/X\d+ Do"


def test_page_turns_fills_the_screen_saves_and_prints(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin, color_scheme="dark", viewport={"width": 800, "height": 480}) as tab:
        tab.run("async () => (await langsplat).page.search('teddy bear')")
        tab.page.focus("#scene")
        tab.page.keyboard.press("t")
        before = tab.run(STATE)
        tab.page.wait_for_timeout(300)
        assert tab.run(STATE)["rotation"] != before["rotation"]
        tab.page.click("#spin")
        assert tab.page.get_attribute("#spin", "aria-pressed") == "false"
        ink = "() => getComputedStyle(document.body).color"
        dark = tab.run(ink)
        tab.page.click("#theme")
        assert tab.run(ink) != dark
        with tab.page.expect_download() as saved:
            tab.page.click("#picture")
        image = np.asarray(Image.open(saved.value.path()).convert("RGB"))
        assert (image.shape, image.std() > 20) == ((480, 800, 3), True)
        streams = re.findall(rb"stream\r?\n(x.*?)endstream", tab.page.pdf(format="A4"), re.DOTALL)
        drawn = re.findall(PLACED, b"".join(map(zlib.decompress, streams)))
        assert len(drawn) == 2  # also below the boxes, whose clear pixels Chromium prints white
        for across, down in drawn:
            assert float(across) / float(down) == pytest.approx(800 / 480, rel=0.01)
        tab.page.click("#full")
        tab.page.wait_for_function("() => document.fullscreenElement === document.body")
        assert tab.faults == []


def test_history_is_shown_before_the_view_rests(browser: Any, thin: Path) -> None:
    with open_tab(browser, thin) as tab:
        never = "async () => clearTimeout(Object.assign((await langsplat).page, { keepUp() {} }).rest)"
        tab.run(never)
        tab.page.keyboard.press("l")
        tab.run("async () => (await langsplat).page.search('ball')")
        tab.page.keyboard.press("f")
        for go, display in ((tab.page.go_back, "latent"), (tab.page.go_forward, "segmentation")):
            go()
            tab.page.locator(f"#displays [value={display}]:checked").wait_for(state="attached")


def test_tags_lie_within_the_window(browser: Any, thin: Path) -> None:
    drawn = """async (at) => {
      const { page } = await langsplat, canvas = document.createElement("canvas");
      page.tag(canvas.getContext("2d"), "teapot", [at], 1);
      return canvas.getContext("2d").getImageData(0, 0, 300, 150).data.filter((byte) => byte).length;
    }"""
    with open_tab(browser, thin) as tab:
        middle = tab.run(drawn, [150, 75])
        there = [tab.run(drawn, at) for at in ([299, 0], [0, 149], [900, 75])]
        assert there == pytest.approx([middle, middle, 0], 0.05)


def test_unsearchable_scenes_are_shown(browser: Any, tmp_path: Path) -> None:
    cameras = tuple(random_camera(seed) for seed in range(2))
    scene = Scene(random_gaussians(40), random_field(40), cameras)
    (alone,) = views(replace(scene, cameras=()))
    pixels, depths = alone.project(scene.gaussians.means)
    assert alone.in_image(pixels, depths).mean() > 0.9  # all but floaters, and no smaller than they must be
    assert (np.ptp(pixels, axis=0) > 0.7 * np.array([alone.width, alone.height])).any()
    text, report = make_page(scene, QueryEngine(scene, no_encoder), "A", notes=[("here", (0.0, 0.0, 0.0))])
    write_whole(tmp_path / "a.html", text)
    assert "autoencoder" in report.why_not
    with open_tab(browser, tmp_path / "a.html") as tab:
        assert tab.page.locator("#search").is_hidden()
        assert tab.page.locator("#about", has_text="autoencoder").is_visible()
        assert tab.page.locator("#labels").is_visible()
        assert tab.faults == []


def test_export_command_writes_a_page_or_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hidden = replace(random_gaussians(4), opacity_logits=np.full(4, -np.inf))
    save_scene(tmp_path / "h.ply", Scene(hidden))
    with pytest.raises(InputError, match="nothing to export"):
        Export(tmp_path / "h.ply", tmp_path / "room.html").run()
    assert not list(tmp_path.glob("*.html"))
    save_scene(tmp_path / "s.ply", Scene(random_gaussians(40)))
    parse(["export", str(tmp_path / "s.ply"), str(tmp_path / "room.html"), "--title", "Über <b>"]).run()
    assert "40 Gaussians" in capsys.readouterr().out
    assert "<title>Über &lt;b&gt;</title>" in (tmp_path / "room.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("phrases", [(), ("laptop",), None, "an answer"])
def test_notebooks_show_a_page_that_was_asked(browser, demo, engine, tmp_path, phrases):
    """In a frame without rights, as a cell has it: bounded, answered over all Gaussians, searchable."""
    if phrases is None:
        path = Path(__file__).parents[2] / "docs" / "examples" / "06_in_a_notebook.ipynb"  # `make notebook`
        shown = "".join(json.loads(path.read_bytes())["cells"][-1]["outputs"][0]["data"]["text/html"])
        asked, other = "duck", "penguin"
        engine = QueryEngine(load_scene(DEMO), load_text_encoder)
    elif phrases == "an answer":
        asked, other = "ball near the teddy bear", "ball"
        shown = run_phrase(engine, asked).answer._repr_html_()
        assert len(shown) < 3.5e6
    else:
        page = demo.show(asked := "teddy bear", at_most=5000, phrases=phrases)
        other, shown = "laptop", page._repr_html_()
        assert page.report.gaussians == 5000
        assert page.report.free_text is (phrases == ())
        assert page.report.bytes < (1.3e6 if phrases else 3.2e6)
        small = demo.cameras[0].within(320)
        assert covered(demo, [small]).sum() == pytest.approx(render(demo, small).alpha.sum(), rel=1e-4)
    (tmp_path / "cell.html").write_text(f"<!doctype html><p>Out [1]</p>{shown}", encoding="utf-8")
    tab = browser.new_page(offline=True)
    tab.goto((tmp_path / "cell.html").as_uri())
    frame = tab.frames[1]
    frame.wait_for_function("typeof langsplat !== 'undefined'")  # it may still hold no document
    said = run_phrase(engine, asked).answer.said
    assert said in frame.evaluate("async () => (await langsplat) && document.body.innerText")
    assert frame.evaluate("async () => (await langsplat).page.display") == "relevancy"
    frame.fill("#phrase", other)
    frame.press("#phrase", "Enter")
    assert frame.evaluate("async () => (await langsplat).page.answers[0]?.phrase") == other
    tab.close()
