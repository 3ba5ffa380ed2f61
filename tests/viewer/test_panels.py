"""Panels change nothing by themselves: what they are told goes through `actions`."""

import ast
import threading
from pathlib import Path

import numpy as np
import pytest
from matplotlib.ft2font import FT2Font

from langsplat_core.errors import InputError
from langsplat_core.scene.transform import AXES, moving, rotating
from langsplat_viewer import panels
from langsplat_viewer.actions import settings, viewpoint
from langsplat_viewer.commands import COMMANDS, PANEL_TITLES, matching
from langsplat_viewer.files.projects import FILE_NAME, load_preferences, save_preferences
from langsplat_viewer.panels import ui
from langsplat_viewer.panels.layout import all_panels
from langsplat_viewer.panels.navigation import chord
from langsplat_viewer.panels.select import box_of, dragged, gl_matrices
from langsplat_viewer.panels.ui import elided
from langsplat_viewer.session import MOST_RECENT, Preferences
from langsplat_viewer.state import MAX_MESSAGES
from tests.support.scenes import random_camera, without_perspective
from tests.support.windowless import settle

SOURCES = sorted(Path(panels.__path__[0]).glob("*.py"))


def is_state(node: ast.expr) -> bool:
    """`state`, `viewer.state`, `anything.state`, or something inside one."""
    match node:
        case ast.Name(id="state") | ast.Attribute(attr="state"):
            return True
        case ast.Attribute(value=inner) | ast.Subscript(value=inner):
            return is_state(inner)
        case _:
            return False


def targets(node: ast.AST) -> list[ast.expr]:
    """What a statement assigns to or deletes, tuples taken apart."""
    match node:
        case ast.Assign(targets=found) | ast.Delete(targets=found):
            pass
        case ast.AugAssign(target=one) | ast.AnnAssign(target=one) | ast.NamedExpr(target=one):
            found = [one]
        case ast.Call(func=ast.Name(id="setattr" | "delattr"), args=[one, *_]):
            return [ast.Attribute(one, "?")]
        case _:
            return []
    return [part for target in found for part in ast.walk(target) if isinstance(part, ast.expr)]


def writes(source: str) -> list[int]:
    """Lines that change the viewer's state."""
    found = []
    for node in ast.walk(ast.parse(source)):
        for target in targets(node):
            if isinstance(target, ast.Attribute | ast.Subscript) and is_state(target.value):
                found.append(getattr(node, "lineno", 0))
    return sorted(set(found))


def test_panels_write_no_state():
    assert len(SOURCES) > 6
    found = [f"{path.name}:{line}" for path in SOURCES for line in writes(path.read_text())]
    assert not found


# The table of commands: keys, help and palette are made from it.


def test_every_key_is_bound_to_one_command():
    keys = [key for command in COMMANDS for key in command.keys]
    assert len(set(keys)) == len(keys)
    for key in keys:
        understood = chord(key)
        assert (understood.key is None) == bool(understood.character)
        assert understood.is_plain == (not key.startswith("Ctrl") and key not in ("F1", "Esc")), key
    assert chord("Ctrl+Shift+P").ctrl
    assert chord("Ctrl+Shift+P").shift
    assert (chord("Alt+H").alt, chord("H").alt) == (True, False)
    assert chord("Shift+F").is_plain  # a capital letter is typed


def test_every_panel_can_be_opened_by_a_command(viewer):
    assert tuple(panel.title for panel in all_panels()) == PANEL_TITLES
    for title in PANEL_TITLES:
        (command,) = matching(f"panel: {title}")
        command.act(viewer)
        assert settings.take(viewer.state, "wanted_panel") == title
    assert settings.take(viewer.state, "wanted_panel") == ""
    assert matching("") == list(COMMANDS)
    assert [command.act for command in matching("OPENING view")] == [viewpoint.reset_view]
    assert matching("make coffee") == []


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


def test_a_job_that_hangs_does_not_keep_the_process(viewer):
    begun, release = threading.Event(), threading.Event()

    def hang(progress):
        begun.set()
        release.wait(10)

    viewer.worker.submit("slow", hang, print, print)
    assert begun.wait(10)
    viewer.worker.close()
    assert viewer.worker.is_running
    assert [t.daemon for t in threading.enumerate() if t.name == "langsplat-worker"] != [False]
    release.set()


def test_long_lines_are_cut_where_they_fit():
    assert elided("red mug", 7, len) == "red mug"
    assert elided("a red mug on the table", 10, len) == "a red m..."
    assert elided("two\nlines", 20, len) == "two lines"
    assert elided("anything", 1, len) == "..."


# What one window leaves for the next.


def test_they_come_back_as_they_were(tmp_path):
    assert load_preferences(tmp_path / "none") == Preferences()
    kept = Preferences("light", 1.5, ("/a/b.ply", "/ü.ply"), ("Search",))
    save_preferences(tmp_path / "new" / "folder", kept)
    assert load_preferences(tmp_path / "new" / "folder") == kept


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"theme": "pink"}',
        '{"theme": []}',
        '{"ui_scale": 0}',
        '{"ui_scale": NaN}',
        '{"ui_scale": true}',
        '{"ui_scale": "large"}',
        '{"recent": 3}',
        '{"recent": [3]}',
        '{"recent": null}',
        '{"panels": "Search"}',
        "[" * 100_000,
        "\xff\xfe",
    ],
)
def test_a_file_that_makes_no_sense_is_one_line(tmp_path, text):
    (tmp_path / FILE_NAME).write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=FILE_NAME) as caught:
        load_preferences(tmp_path)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def test_letters_recent_scenes_and_looks_stay_within_limits(viewer):
    wanted = Preferences()
    most = MOST_RECENT
    for number in (*range(most + 3), 5):
        wanted = wanted.with_recent(Path(f"/{number}.ply"))
    assert len(wanted.recent) == most
    assert wanted.recent[:2] == ("/5.ply", f"/{most + 2}.ply")


# Letters beyond Latin.


def test_the_first_fallback_has_the_scripts_that_it_is_there_for():
    letters = FT2Font(ui.fallbacks()[0]).get_charmap()
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
