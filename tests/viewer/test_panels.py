"""Panels, the table of commands, preferences, and what is drawn over the image."""

import math
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from matplotlib.ft2font import FT2Font

from langsplat_core.errors import InputError
from langsplat_core.query import instances
from langsplat_core.query.describe import Describer, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import look_at
from langsplat_core.scene.transform import AXES, moving, rotating
from langsplat_viewer import panels
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.camera import overlays
from langsplat_viewer.camera.controls import extent_of, frame_of
from langsplat_viewer.camera.overlays import PlacedText, placed
from langsplat_viewer.commands import COMMANDS, matching
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.panels.layout import all_panels
from langsplat_viewer.panels.navigation import chord
from langsplat_viewer.panels.overlays import pointed_figures, said
from langsplat_viewer.panels.select import box_of, dragged, gl_matrices
from langsplat_viewer.panels.ui import elided
from langsplat_viewer.state import MAX_MESSAGES
from tests.support.fakes import CENTRES, FakeEncoder, blob_scene, cameras
from tests.support.scenes import random_camera, without_perspective
from tests.support.windowless import ask, errors, open_scene, settle

SOURCES = sorted(Path(panels.__path__[0]).glob("*.py"))


WRITES = re.compile(r"^ *(?:del )?(?:\w+\.)*state(?:\.\w+|\[.*?\])+(?:, .*)? *[-+|&^]?=(?!=)", re.M)


def test_panels_write_no_state():
    assert WRITES.search("    viewer.state.record.at = 1")
    assert len(SOURCES) > 6
    assert [path.name for path in SOURCES if WRITES.search(path.read_text())] == []


# The table of commands: keys, help and palette are made from it.


def test_every_key_is_bound_to_one_command():
    keys = [key for command in COMMANDS for key in command.keys]
    assert len(set(keys)) == len(keys)
    for key in keys:
        understood = chord(key)
        assert (understood.key is None) == bool(understood.character)
        assert understood.is_plain == (not key.startswith("Ctrl") and key not in ("F1", "Esc")), key
    assert chord("Ctrl+Shift+P").held == chord("Ctrl+P").held | chord("Shift+P").held > chord("H").held == 0
    assert chord("Shift+F").is_plain  # a capital letter is typed


def test_every_panel_can_be_opened_by_a_command(viewer):
    opens = {panel.title: panel.opens for panel in all_panels()}
    for title in opens:
        (command,) = matching(f"panel: {title}", list(opens.values()))
        command.act(viewer)
        assert settings.take(viewer.state, "wanted_panel") == title
    assert settings.take(viewer.state, "wanted_panel") == ""
    assert matching("") == list(COMMANDS)
    assert [command.act for command in matching("OPENING view")] == [viewpoint.reset_view]
    assert matching("make coffee") == []


def test_palette_finds_commands_by_other_words():
    for word, does in (("screenshot", "save a picture"), ("fit", "frame everything"), ("exit", "quit")):
        assert does in [command.does for command in matching(word)]
    assert matching("full screen")[0].act is settings.toggle_panels
    assert matching("reload")[0].keys == ("F5",)  # its own words before others'


def test_every_command_runs_without_a_scene(viewer, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in COMMANDS:
        command.act(viewer)
    assert list(tmp_path.iterdir()) == []


# What is shown and how; messages; the worker.


def test_messages_are_bounded_and_not_repeated(viewer):
    for number in [*range(3 * MAX_MESSAGES), 3 * MAX_MESSAGES - 1]:
        viewer.state.say(f"message {number}")
    numbers = [int(message.text.split()[1]) for message in viewer.state.messages]
    assert numbers == list(range(2 * MAX_MESSAGES, 3 * MAX_MESSAGES))


def test_worker_delivers_in_order_and_wakes_the_window(viewer):
    seen, woken = [], []
    viewer.worker.wake = lambda: woken.append(viewer.worker.is_running)

    def fail(progress):
        raise InputError("two\n lines")

    viewer.worker.submit("a", lambda progress: 1, seen.append, seen.append)
    viewer.worker.submit("b", fail, seen.append, seen.append)
    viewer.worker.submit("c", lambda progress: progress("half", 0.5) or 3, seen.append, seen.append)
    settle(viewer)
    assert seen == [1, "two lines", 3]
    assert len(woken) == 4  # a report, and three ends
    assert (viewer.worker.delivered, viewer.worker.is_running) == (3, False)


def test_long_lines_are_cut_where_they_fit():
    assert elided("red mug", 7, len) == "red mug"
    assert elided("a red mug on the table", 10, len) == "a red m..."
    assert elided("two\nlines", 20, len) == "two lines"
    assert elided("anything", 1, len) == "..."


# The theme.


def blended(over: tuple[float, ...], below: tuple[float, ...]) -> tuple[float, ...]:
    *colour, alpha = over
    return tuple(alpha * top + (1 - alpha) * low for top, low in zip(colour, below, strict=True))


def luminance(colour: tuple[float, ...]) -> float:
    """Relative luminance, as WCAG 2 defines it."""
    linear = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in colour)
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("name", theme.THEMES)
def test_every_text_stands_out_from_what_it_lies_on(name):
    def rgba(part: str) -> tuple[float, ...]:
        return theme.rgba(part, name)

    plain = [blended(rgba(ground), (0.0,) * 3) for ground in ("ground", "raised", "glass")]
    grounds = [*plain, blended(rgba("glass"), (1.0,) * 3)]  # glass, over black and white scenes
    over = [blended(rgba(part), low) for low in grounds for part in ("field", "button", "hover")]
    lit = [blended(rgba(part), low) for low in grounds for part in ("pressed", "grab")]
    for text in ("ink", "soft", "accent", "good", "weak", "bad"):
        colour = luminance(rgba(text)[:3])
        for place in (*grounds, *over, *(lit if text == "ink" else ())):
            low, high = sorted((luminance(place), colour))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (text, place)


# Letters beyond Latin.


def test_the_first_fallback_has_the_scripts_that_it_is_there_for():
    letters = FT2Font(str(ui.fallbacks()[0])).get_charmap()
    for text in ("жук", "κούπα", "čaj żółć", "ספל", "كوب", "→ ≥ ✓"):
        assert all(ord(letter) in letters for letter in text if letter != " "), text


# The gizmo.


@pytest.mark.parametrize("perspective", [True, False])
def test_gizmo_matrices_agree_with_the_camera(perspective):
    camera = random_camera(3)
    camera = camera if perspective else without_perspective(camera)
    points = np.random.default_rng(0).normal(scale=0.3, size=(20, 3))
    view, projection = gl_matrices(camera, 3.0)
    clip = np.c_[points, np.ones(20)] @ (projection @ view).T
    x, y, depth = (clip[:, :3] / clip[:, 3:]).T
    pixels, _ = camera.project(points)
    np.testing.assert_allclose((x + 1) / 2 * camera.width, pixels[:, 0], atol=1e-9)
    np.testing.assert_allclose((1 - y) / 2 * camera.height, pixels[:, 1], atol=1e-9)
    assert (np.abs(depth) < 1).all()


def test_gizmo_drags_become_similarities():
    box = np.diag([2.0, -4.0, 6.0, 1.0])  # a handle was dragged beyond the opposite one
    box[:3, 3] = 1.0, 2.0, 3.0
    assert box_of(box) == ((0.0, 0.0, 0.0), (2.0, 4.0, 6.0))
    start = moving(np.array([1.0, 2.0, 3.0])).matrix
    turned = rotating(AXES["y"], 20).about(start[:3, 3])
    np.testing.assert_allclose(dragged(start, turned.matrix @ start).matrix, turned.matrix, atol=1e-9)
    stretched = start.copy()
    stretched[:3, :3] = np.diag([1.0, 1.4, 1.0])
    grown = dragged(start, stretched)
    assert grown.scale == pytest.approx(1.4)
    np.testing.assert_allclose(grown.points(start[None, :3, 3])[0], start[:3, 3])
    stretched[:3, :3] = 0
    with pytest.raises(InputError):
        dragged(start, stretched)


SIZE = (120, 80)
NEAR = 0.05


def plain_clip(camera, start, end):
    """One segment cut at one plane after the other, in plain Python: (2, 2) pixels or None."""
    a, b = (camera.rotation @ p + camera.world_to_camera[:3, 3] for p in (start, end))
    planes = [
        lambda p: p[2] - NEAR,
        lambda p: camera.fx * p[0] + camera.cx * p[2],
        lambda p: (camera.width - camera.cx) * p[2] - camera.fx * p[0],
        lambda p: camera.fy * p[1] + camera.cy * p[2],
        lambda p: (camera.height - camera.cy) * p[2] - camera.fy * p[1],
    ]
    for side in planes:
        if side(a) < 0 and side(b) < 0:
            return None
        if side(a) < 0:
            a = a + side(a) / (side(a) - side(b)) * (b - a)
        elif side(b) < 0:
            b = b + side(b) / (side(b) - side(a)) * (a - b)
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return np.array([p[:2] / p[2] * focal + middle for p in (a, b)])


def test_segments_are_clipped_ahead_of_the_eye():
    rng = np.random.default_rng(4)
    camera = look_at(np.array([0.3, -0.2, -2.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    segments = rng.normal(scale=2.5, size=(4000, 2, 3))
    got, rows = overlays.clip_segments(camera, segments, NEAR)
    expected = [plain_clip(camera, *segment) for segment in segments]
    assert rows.tolist() == [row for row, cut in enumerate(expected) if cut is not None]
    assert 500 < len(rows) < 3500
    np.testing.assert_allclose(got, [cut for cut in expected if cut is not None], atol=1e-6)
    assert got.min() > -1e-6
    assert (got.max((0, 1)) < np.array(SIZE) + 1e-6).all()
    camera = look_at(np.array([0, 0, -2.0]), np.zeros(3), np.array([0, -1.0, 0]), SIZE)
    through = np.array([[[0, 0, -4.0], [0, 0, 3.0]], [[0, 0, -9.0], [0, 0, -3.0]]])
    got, rows = overlays.clip_segments(camera, through, NEAR)
    assert rows.tolist() == [0]
    np.testing.assert_allclose(got[0], [[60, 40], [60, 40]], atol=1e-9)
    far = np.array([[[-1e9, 0, 1.0], [1e9, 0, 1.0]]])
    np.testing.assert_allclose(overlays.clip_segments(camera, far, NEAR)[0][0, :, 0], [0, 120], atol=1e-3)
    assert len(overlays.clip_segments(camera, np.zeros((0, 2, 3)), NEAR)[0]) == 0


def test_frusta_nearest_segments_and_edges_of_boxes():
    camera = cameras()[1]
    edges = overlays.frusta((camera,), 0.4)[0]
    np.testing.assert_allclose(edges[:4, 0], np.tile(camera.position, (4, 1)), atol=1e-12)
    pixels, depths = camera.project(edges[:4, 1])
    np.testing.assert_allclose(depths, 0.4)
    np.testing.assert_allclose(pixels, [(0, 0), (160, 0), (160, 120), (0, 120)], atol=1e-9)
    assert overlays.frusta((camera,), 0.4) is overlays.frusta((camera,), 0.4)
    assert overlays.frusta((), 1.0).shape == (0, 8, 2, 3)
    segments = np.array([[[0.0, 0], [10, 0]], [[0, 5], [10, 5]], [[3, 3], [3, 3]]])
    assert overlays.nearest_segment(segments, (20.0, 0.0)) == (0, 10.0)
    assert overlays.nearest_segment(segments, (6.0, 4.5)) == (1, 0.5)
    assert overlays.nearest_segment(segments, (3.0, 2.9))[0] == 2
    assert overlays.nearest_segment(segments[:0], (0.0, 0.0)) == (-1, math.inf)
    box = instances.OrientedBox(np.array([1.0, 2, 3]), np.eye(3), np.array([3.0, 2, 1]))
    edges = overlays.box_edges(box.corners)
    lengths = np.sort(np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1))
    np.testing.assert_allclose(lengths, [2.0] * 4 + [4.0] * 4 + [6.0] * 4)
    assert len({tuple(sorted(map(tuple, edge))) for edge in edges.tolist()}) == 12


@pytest.mark.parametrize(
    ("length", "rounded"), [(1, 1), (1.3, 1), (1.5, 2), (0.031, 0.02), (4, 5), (88, 100), (7e-9, 5e-9)]
)
def test_round_lengths(length, rounded):
    assert overlays.round_length(length) == pytest.approx(rounded)


@pytest.mark.parametrize("scale", [None, 0.3])
def test_the_grid_lies_level_below_the_scene_at_round_distances(scale):
    scene = blob_scene()
    extent, up = extent_of(scene), np.array([0, -1.0, 0])
    lines, spacing = overlays.ground_grid(extent, up, scale)
    heights = lines @ up
    assert np.ptp(heights) < 1e-9
    below = (scene.gaussians.means.astype(float) @ up < heights[0, 0]).mean()
    assert 0 < below < 0.05
    unit = scale or 1.0
    assert overlays.round_length(spacing * unit) == pytest.approx(spacing * unit)
    right = lines[:, 0] @ frame_of(up)[0]
    np.testing.assert_allclose(right / spacing, np.rint(right / spacing), atol=1e-9)
    assert 8 < len(lines) < 40


# Words beside things: none covers another, and they stay where they are while nothing meets.

PICTURE = (400.0, 300.0)


def test_labels_that_meet_lie_one_above_the_other():
    for wanted, heights in (((45, 50, 60), [45, 25, 5]), ((0, 3, 6), [0, 20, 40])):  # else below
        labels = placed([PlacedText(0, y, 50, 20) for y in wanted], PICTURE)
        assert [label.y for label in labels] == heights
    panel, label = PlacedText(0, 10, 200, 150), PlacedText(20, 40, 50, 20)
    assert placed([label], PICTURE, [panel]) == [replace(label, y=160)]
    assert placed([label], PICTURE, [replace(panel, height=280)]) == [label]  # without room it stays


@pytest.mark.parametrize("seed", range(10))
def test_labels_in_the_open_do_not_cover_each_other_or_a_panel(seed):
    wanted = np.random.default_rng(seed).uniform((-20, 480, 20), (420, 820, 90), (25, 3)).tolist()
    panel = PlacedText(0.0, 500.0, 200.0, 150.0)
    found = placed([PlacedText(x, y, width, 18.0) for x, y, width in wanted], (PICTURE[0], 900.0), [panel])
    assert not any(a.covers(b) for a, b in combinations((panel, *found), 2))
    assert all(0 <= label.x <= PICTURE[0] - label.width for label in found)


# What is said beside the cursor, without a window.


@pytest.fixture(scope="module")
def compiled() -> None:
    """The kernels that look at a pixel: half a minute on a fresh machine."""
    engine = QueryEngine(blob_scene(), lambda encoder_id: FakeEncoder())
    camera = engine.scene.cameras[0].resized(16, 12)
    look_at_pixel(Describer(engine, ("mug",)), camera, (8, 6))


@pytest.fixture
def pointing(compiled, opened):
    """The mug asked for, and the mouse asked about."""
    settings.resize(opened, 160, 120)
    ask(opened, "mug")
    viewpoint.toggle_pointing(opened)
    return opened


def at(viewer, thing: int) -> tuple[int, int]:
    x, y = viewer.state.open.view.camera(160, 120).project(CENTRES[thing][None])[0][0]
    return int(x), int(y)


def rest(viewer, pixel, seconds: float = 0.5) -> None:
    """The mouse lies still there."""
    began = viewer.clock
    for now in (began, began + seconds):
        viewpoint.tick(viewer, now)
        viewpoint.hover(viewer, pixel)
    settle(viewer)


def test_tooltip_appears_when_the_mouse_stops(pointing):
    rest(pointing, at(pointing, 0), seconds=0.05)
    assert pointing.state.hover.found is None
    rest(pointing, at(pointing, 0))
    found = pointing.state.hover
    assert found.phrases == ("mug",)
    assert found.found.relevancy[0] > 0.9
    assert "mug" in said(found.found.words[2], sure=False)
    assert "%" not in said(found.found.words[2], sure=False)
    assert "mug 100 %" in said(found.found.words[2], sure=True)
    first, *_, last = pointed_figures(found)
    assert (first[:5], "away" in last) == ("mug: ", True)


def test_tooltip_disappears_when_mouse_or_camera_moves(pointing):
    rest(pointing, at(pointing, 0))
    viewpoint.hover(pointing, (3, 4))
    assert pointing.state.hover.found is None
    rest(pointing, at(pointing, 1))
    assert pointing.state.hover.found is not None
    viewpoint.step_camera(pointing, 1)
    for now in (10.0, 11.0):
        viewpoint.tick(pointing, now)
    viewpoint.hover(pointing, at(pointing, 1))
    assert pointing.state.hover.found is None
    for elsewhere in (None, (-1, 5), (160, 5), (5, 120)):
        viewpoint.hover(pointing, elsewhere)
        assert pointing.state.hover is None
    open_scene(pointing, "plain.ply")  # which means nothing
    assert not pointing.state.pointing
    viewpoint.toggle_pointing(pointing)
    assert not pointing.state.pointing
    assert errors(pointing)
