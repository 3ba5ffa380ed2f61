"""Scenarios of `window_driver` in the panels: files, training, layout, recording, bookmarks, keys."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.windowless import answer, result

from imgui_bundle import imgui  # isort: skip
from imgui_bundle.glfw_utils import glfw_window_hello_imgui  # isort: skip
import glfw  # isort: skip
from langsplat_core.extensions.library import panel as library_panel
from langsplat_core.io.scenes import save_scene
from langsplat_core.semantics.features import ImageFeatures
from langsplat_viewer import viewer as training
from langsplat_viewer.actions import editing, opening, settings, viewpoint
from langsplat_viewer.commands import COMMANDS
from langsplat_viewer.files.projects import read_flight
from langsplat_viewer.panels.layout import all_panels
from langsplat_viewer.panels.menus import button_label
from langsplat_viewer.panels.ui import scene_area
from tests.support.fakes import CENTRES, PER_BLOB, as_trained, blob_scene, cameras, named_scene


def reload_what_changed(s: Any) -> None:
    """A bar appears by itself, its button reads the file again, camera and queries stay."""
    s.search("mug")
    s.drag((600, 300), (656, 279))
    view, before = s.state.view, s.state.scene
    assert not s.ctx.item_exists("//changed/Reload")
    scene = replace(blob_scene(), path=None)
    save_scene(s.state.path, replace(scene, gaussians=replace(scene.gaussians, sh=-scene.gaussians.sh)))
    s.until(lambda: s.viewer.watch.changed)
    s.ctx.item_click("//changed/Reload")
    s.until(lambda: s.state.scene is not before)
    assert s.state.view is view
    assert result(s, 0).found
    assert not s.ctx.item_exists("//changed/Reload")
    hot = s.at(s.shot("reloaded"), CENTRES[0])
    assert hot[0] > hot[2] + 60


def see_the_evidence(s: Any) -> None:
    """The sheet lies in a window over the scene, until that is closed."""
    scene = blob_scene()
    seen = ImageFeatures(np.zeros((3, 120, 160), np.int32), np.eye(1, 8, dtype=np.float32))
    as_trained(s.state.path, scene, [seen] * len(scene.cameras))
    s.search("mug")
    plain, area = s.shot("plain"), scene_area()
    s.ctx.item_click("//Search/Why?")
    s.wait(lambda: s.state.evidence is not None)
    s.ctx.mouse_move_to_pos((area.left + area.width / 2, area.top + area.height - 20))  # its tooltip goes
    s.ctx.yield_(3)
    inside = np.s_[int(area.top) + 60 : int(area.top) + 200, int(area.left) + 40 : int(area.left) + 400]
    assert (s.shot("evidence")[inside] == 255).all(-1).mean() > 0.2 > (plain[inside] == 255).all(-1).mean()
    s.ctx.window_close("//###evidence")
    s.ctx.yield_(2)
    assert s.state.evidence is None


def switch_between_scenes(s: Any) -> None:
    """Dropped together; the list in the panel shows one after the other, as it was left."""
    s.drop("blobs.ply", "plain.ply")
    assert [path.name for path in s.state.scenes] == ["blobs.ply", "plain.ply"]
    s.drag((600, 300), (656, 279))
    view = s.state.view
    s.ctx.item_click("//**/plain.ply##scenes")
    s.shows("plain.ply")
    assert s.state.view is not view
    s.key("Ctrl+page_up", frames=1)
    s.shows("blobs.ply")
    assert s.state.view is view


def search_a_library(s: Any) -> None:
    """The panel lists the scenes of a folder; a phrase ranks them, a click opens one and asks it there."""
    viewer = s.viewer
    save_scene(s.folder / "deep" / "named.ply", replace(named_scene(), path=None))
    fewer = named_scene().take(np.arange(3 * PER_BLOB) < PER_BLOB)
    save_scene(s.folder / "deep" / "mug.ply", replace(fewer, cameras=cameras()))
    s.open_panel("Library", frames=3)
    s.click("//Library/Folder ...", frames=4)
    opening.open_typed(viewer, "deep")
    s.ctx.yield_(3)
    s.ctx.item_click("//**/Take this folder")
    s.until(lambda: library_panel.library_view(viewer) is not None)
    assert len(library_panel.library_view(viewer).hits) == 2
    library_panel.ask_library(viewer, "plant")
    s.until(lambda: library_panel.library_view(viewer).phrase == "plant")
    hits = [(hit.path.name, hit.verdict) for hit in library_panel.library_view(viewer).hits]
    assert hits == [("named.ply", "found"), ("mug.ply", "not here")]
    s.ctx.item_click("//**/$$0/##scene")
    s.shows("named.ply")
    assert s.state.session.queries[0].phrase == "plant"
    assert result(s, 0).found


TRAINS = """
import json, sys, time
for step in range(60):
    report = {"stage": "training Gaussians", "fraction": step / 60, "note": f"{300 + step} Gaussians"}
    report["metrics"] = {"loss": 0.04 + 0.2 / (1 + step)}
    print(json.dumps(report), file=sys.stderr, flush=True)
time.sleep(60)
"""


def watch_a_training(s: Any) -> None:
    """The panel plots what the process says of its loss."""
    viewer, photographs = s.viewer, s.folder / "photos"
    photographs.mkdir()
    for number in range(3):
        (photographs / f"{number}.jpg").write_bytes(b"")
    training.command = lambda request: [sys.executable, "-c", TRAINS]
    opening.choose_photographs(viewer, photographs)
    s.open_panel("Train", frames=3)
    s.ctx.item_click("//Train/Train")
    s.wait(lambda: viewer.training is not None and len(viewer.training.progress.losses) > 50)
    shot, plot = s.shot("loss"), s.ctx.item_info("//Train/##loss").rect_full
    inside = shot[int(plot.min.y) : int(plot.max.y), int(plot.min.x) : int(plot.max.x)]
    assert np.ptp(inside) > 60
    s.ctx.item_click("//Train/Stop")
    s.wait(lambda: viewer.training is None)
    assert "training stopped" in s.state.messages[-1].text


# Where things lie: large letters, long words.

LONG = "mugg or boook or plent or mugg or boook or plent or mugg or boook or plent or mugg"


def large_letters(s: Any) -> None:
    """At twice the size, in a small window: the column grows, and no widget of any panel is cut off."""
    for phrase in ("mug or plant", LONG):
        s.search(phrase)
    assert answer(s, -1).meant  # a long one, and so is the button for it
    narrow = scene_area().left
    settings.prefer(s.viewer, ui_scale=2.0)
    s.settle()
    assert 1.3 * narrow < scene_area().left <= 0.41 * 1280
    for panel in all_panels():
        s.open_panel(panel.title)
        items = imgui.test_engine.TestItemList()
        s.ctx.gather_items(items, f"//{panel.title}")
        assert items.get_size() > 0, panel.title
        for item in map(items.get_by_index, range(items.get_size())):
            assert item.rect_full.max.x <= item.window.inner_rect.max.x + 1, panel.title
    for scale, show, name in (
        (2.0, lambda viewer: settings.put(viewer.state, show_help=True), "Help"),
        (3.0, settings.toggle_palette, "Commands"),
        (3.0, opening.ask_for_file, "Open a scene"),
    ):
        settings.prefer(s.viewer, ui_scale=scale)
        show(s.viewer)
        s.settle()
        over = s.ctx.window_info(f"//{name}").window
        assert 0 <= over.pos.x <= over.pos.x + over.size.x <= 1280, name
        assert 0 <= over.pos.y <= over.pos.y + over.size.y <= 720, name
        settings.escape(s.viewer)
    settings.prefer(s.viewer, ui_scale=1.0)
    s.settle()
    assert abs(scene_area().left - narrow) < 0.15 * narrow


def use_the_outline(s: Any) -> None:
    """Rows are clicked and hidden; the menu of a thing names it."""
    s.search("mug")
    s.open_panel("Outline", frames=1)
    s.until(lambda: s.state.outline is not None and len(s.state.outline.roots) > 0)
    first = s.state.outline.roots[0].node
    row = f"//**/node {first}/###"
    s.click(f"{row}row")
    chosen = s.state.marks.selected
    assert (chosen == s.state.outline.tree.members(first)).all()
    s.click(f"{row}eye")
    assert (s.state.marks.hidden == chosen).all()
    s.click(f"{row}eye")

    use_the_outline_by_keys(s, first)
    s.key("R")
    s.ctx.mouse_move_to_pos(s.on_screen(CENTRES[1]))
    s.ctx.yield_(2)
    s.ctx.mouse_click(1)
    s.ctx.yield_(3)
    s.ctx.item_click("//**/##name this")
    s.enter("the atlas")
    assert s.state.session.queries[-1].phrase == "the atlas"
    assert result(s, -1).members.reshape(3, -1).all(1).tolist() == [False, True, False]


def use_the_outline_by_keys(s: Any, node: int) -> None:
    """From the filter down to a row: Enter looks at the thing, the menu key opens what can be done."""
    s.open_panel("Outline", frames=1)
    editing.select_none(s.viewer)
    s.ctx.item_click("//**/##filter")
    s.key("down_arrow", frames=2)
    s.key("enter")
    assert (s.state.marks.selected == s.state.outline.tree.members(node)).all()
    editing.select_none(s.viewer)
    s.key("menu", frames=3)
    s.key("down_arrow", frames=2)
    s.key("enter")
    assert (s.state.marks.selected == s.state.outline.tree.members(node)).all()


# The panel "Record", bookmarks, sides.


def record_and_play(s: Any) -> None:
    """Keyframes by a key, played in the window, saved as a path and as a film."""
    record = s.state.record
    s.open_panel("Record", frames=4)
    for end in ((656, 300), (700, 320)):
        s.key("K", frames=1)
        s.drag((600, 300), end)
    s.click("//Record/Add keyframe", frames=2)
    assert [key.seconds for key in s.state.session.keyframes] == [0, 2, 4]
    last = s.state.view
    s.ctx.item_click("//Record/Clear")
    s.key("Ctrl+Z", frames=2)
    assert len(s.state.session.keyframes) == 3

    viewpoint.set_path_seconds(s.viewer, 60.0)  # longer than a frame may take
    start = s.shot("start")
    s.ctx.item_click("//Record/Play##path")
    s.wait(lambda: 0.2 < record.at < 60.0)
    moving = s.state.view
    viewpoint.set_path_seconds(s.viewer, 1.0)
    s.ctx.item_click("//Record/Play##path")
    s.wait(lambda: record.began is None)
    assert record.at == 1.0
    np.testing.assert_allclose(s.state.view.eye, last.eye, atol=1e-6)
    assert np.abs(moving.eye - last.eye).max() > 1e-3
    viewpoint.set_path_seconds(s.viewer, 60.0)
    s.key("Shift+K", frames=1)  # from the start again
    s.wait(lambda: 0 < record.at < 59.0)
    s.drag((600, 300), (620, 310))  # the hand is stronger
    assert record.began is None
    assert np.abs(s.shot("elsewhere") - start)[100:500, 400:].max() > 30

    s.click("//Record/Save path", frames=2)
    assert len(read_flight(s.folder / "blobs-001.path.json").keyframes) == 3
    viewpoint.set_path_seconds(s.viewer, 1.0)
    settings.put(s.viewer.state.record, size=(32, 24))
    s.viewer.state.record.fps = 4.0
    s.viewer.state.record.film_file = "film"
    s.ctx.item_click("//Record/Save film")
    s.until(lambda: s.viewer.recorder.current is None)
    assert len(list((s.folder / "film").glob("frame-*.png"))) == 5


def mark_and_return(s: Any) -> None:
    """A bookmark by its key, the sides by theirs."""
    s.key("Ctrl+B", frames=2)
    start = s.state.view
    s.key("keypad7")
    np.testing.assert_allclose(s.state.view.rotation[2], -start.up, atol=1e-6)
    s.open_panel("Bookmarks", frames=4)
    s.click("//**/view 1##bookmarks")
    np.testing.assert_allclose(s.state.view.rotation, start.rotation, atol=1e-6)
    s.ctx.item_click("//**/##bookmark")
    s.enter("by the key of k", frames=2)
    assert [mark.name for mark in s.state.session.bookmarks] == ["view 1", "by the key of k"]
    assert s.state.session.keyframes == ()


# Keys, palette, toolbar, and where panels lie.


def use_the_palette(s: Any) -> None:
    """Its keys keep away from the scrollbar; Enter does the first command that matches, which is lit."""
    s.key("Ctrl+Shift+P", frames=3)
    box, bar = s.ctx.item_info("//Commands/##command").rect_full, imgui.get_style().scrollbar_size
    right, rows = int(box.max.x - bar), slice(int(box.max.y) + 30, int(box.max.y) + 150)
    seen = s.shot("palette")[rows]
    assert np.ptp(seen[:, right - 100 : right], axis=0).max() > 60  # keys
    assert np.ptp(seen[:, right - 5 : right - 1], axis=0).max() < 10
    s.enter("show depth", frames=3)
    assert s.state.session.picture.display == "depth"
    assert not s.state.show_palette

    s.key("Ctrl+Shift+P", frames=3)
    for width, height in ((1100, 600), (200, 150)):
        resize(s, width, height)
        palette = s.ctx.window_info("//Commands").window
        assert abs(palette.pos.x + palette.size.x / 2 - width / 2) < 2 or width == 200
        assert 0 <= palette.pos.x <= palette.pos.x + palette.size.x <= width
    s.key("escape", frames=1)
    resize(s, 860, 620)


def resize(s: Any, width: int, height: int) -> None:
    glfw.set_window_size(glfw_window_hello_imgui(), width, height)
    s.until(lambda: imgui.get_main_viewport().size.x == width)


def use_shortcuts(s: Any) -> None:
    """Chords work everywhere, letters only by themselves and never while typing."""
    before = s.state.view
    for key in "RPD2E":
        s.key(f"Ctrl+{key}", frames=3)
    assert s.state.view is before
    assert s.state.session.picture.display == "rgb"
    assert not list(s.folder.glob("blobs-*.png"))

    s.key("Ctrl+F", frames=3)
    s.type("far", frames=3)
    assert (s.state.drafts["##phrase"], s.state.view is before) == ("far", True)
    s.key("f1", frames=2)  # also while typing
    assert s.state.show_help
    s.key("f1", frames=1)
    s.key("escape", frames=3)
    assert not imgui.get_io().want_text_input
    assert not s.state.show_help
    s.key("Shift+F")
    assert s.state.view is not before
    for back, start in (("home", (600, 300)), ("R", (560, 340))):  # apart: never a double click
        s.drag(start, (656, 279))
        s.key(back)
        first = s.state.scene.cameras[0].world_to_camera
        np.testing.assert_allclose(s.state.view.camera(160, 120).world_to_camera, first, atol=1e-9)

    s.key("Ctrl+S", frames=1)
    s.wait((s.folder / "blobs-001.png").exists)
    s.type("?")
    assert s.state.show_help
    s.key("escape", frames=1)
    use_the_palette(s)
    s.key("Ctrl+Z", frames=2)
    assert s.state.session.picture.display == "rgb"
    s.key("Ctrl+O", frames=3)
    assert s.ctx.item_exists("//**/##path")


def use_the_toolbar(s: Any) -> None:
    """Every icon does what its command does, and is lit where that is on."""
    labels = {row.does: button_label(row).replace("/", "\\/") for row in COMMANDS if row.icon}
    icons = {does: f"//toolbar/{label}" for does, label in labels.items()}
    for does, icon in icons.items():
        assert s.ctx.item_exists(icon), does
    s.ctx.item_click(icons["show depth"])
    s.click(icons["select: lasso"], frames=2)
    assert (s.state.session.picture.display, s.state.tools.tool) == ("depth", "lasso")
    s.ctx.item_click(icons["select with no tool: the left button turns the view"])
    for phrase in ("mug", "book"):
        s.search(phrase)
    s.click("//**/Fixed heat scale", frames=2)
    lows, highs = zip(*(found.heat_range for found in s.state.shown_results()), strict=True)
    assert s.state.session.picture.heat_scale == (min(lows), max(highs))


def many_queries(s: Any) -> None:
    """However many there are and however long: the list keeps its place, the newest is on top."""
    display = s.ctx.item_info("//**/Colours").rect_full.min.y
    long = "a mug or a book or a plant or another mug or plant"
    for phrase in ("mug", "plant", "book or plant", long, "pot"):
        s.search(phrase)
        assert s.ctx.item_info("//**/Colours").rect_full.min.y == display
    names = [f"//**/{query.phrase}/x" for query in s.state.session.queries]
    closes = [s.ctx.item_info(name).rect_full for name in names if s.ctx.item_exists(name)]
    ((_, right),) = {(rect.min.x, rect.max.x) for rect in closes}
    assert right <= s.ctx.item_info("//Search/Search").rect_full.max.x + 1
    phrase = s.state.session.queries[-1].phrase
    s.click(f"//**/{phrase}/x", frames=2)
    assert phrase not in [query.phrase for query in s.state.session.queries]
    assert s.ctx.item_info("//**/Colours").rect_full.min.y == display


def arrange_panels(s: Any) -> None:
    """Menus do what keys do; panels are closed, opened and moved; the browser opens a scene."""
    s.menu("View", "Show depth")
    assert s.state.session.picture.display == "depth"
    s.menu("Window", "Light theme")
    light = s.shot("light")
    assert light[300:500, 5].min() > 150
    whole = s.state.size
    for title in ("Search", "Scene", "Display", "Camera", "Messages"):
        s.menu("Window", title)
    assert s.state.size[0] == 860 > whole[0]  # the scene has taken their place
    s.key("Ctrl+F", frames=4)
    s.type("mug", frames=3)
    assert s.state.drafts["##phrase"] == "mug"  # the panel is open again, and its box has the keyboard
    s.key("escape", frames=1)
    s.menu("Window", "Reset the layout")
    for title in ("Scene", "Display", "Camera", "Messages"):
        if not s.ctx.item_exists(f"//{title}"):
            s.menu("Window", title)
    s.key("Ctrl+O")
    assert s.state.browser.folder == s.folder.absolute()
    s.ctx.item_click("//**/plain.ply")
    s.shows("plain.ply")
    assert s.state.browser is None
    s.key("Ctrl+O", frames=4)
    s.key("escape", frames=3)
    assert s.state.browser is None


def leave_settings(s: Any) -> None:
    """The next window finds them; see `find_settings`."""
    assert s.state.show_help  # at the first start
    s.key("escape", frames=1)
    s.menu("Window", "Light theme")
    for title in ("Select", "Train", "Record"):  # which do not lie over the search the next time
        s.menu("Window", title)
    s.menu("Window", "Display")
    s.key("f11")  # hidden at the end, there again the next time
    assert s.state.size[0] == 860


def find_settings(s: Any) -> None:
    """What `leave_settings` has left."""
    assert not s.state.show_help
    assert s.state.preferences.theme == "light"
    assert [Path(path).name for path in s.state.preferences.recent] == ["blobs.ply"]
    assert s.state.size[0] < 700
    assert s.ctx.item_exists("//**/##phrase")
    assert not s.ctx.item_exists("//**/Colours")


def travel_by_keys(s: Any) -> None:
    """Esc closes a menu; Tab goes from field to field, and the panels stay; the palette knows everything."""
    s.ctx.item_click("//**/##MenuBar/View")
    assert imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    s.key("escape", frames=2)
    assert not imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    s.key("Ctrl+F", frames=4)
    seen = set()
    for _ in range(12):
        s.key("tab", frames=2)
        seen.add(imgui.internal.get_focus_id())
    assert len(seen) > 5
    assert s.state.show_panel
    for words, done in (
        ("light theme", lambda: s.state.preferences.theme == "light"),
        ("larger text", lambda: s.state.preferences.ui_scale == 1.25),
        ("open plain", lambda: s.state.path.name == "plain.ply"),
    ):
        if words == "open plain":
            s.state.preferences = s.state.preferences.with_recent(s.folder / "plain.ply")
        s.key("Ctrl+Shift+P", frames=3)
        s.ctx.key_chars_append_enter(words)
        s.until(done)
    s.key("Ctrl+Shift+P", frames=3)
    s.type("show")  # arrows choose another command than the first
    for _ in range(3):
        s.key("down_arrow", frames=2)
    s.key("enter", frames=3)
    assert s.state.session.picture.display == "depth"
    s.key("Ctrl+Shift+P", frames=3)
    s.enter("teleport", frames=3)
    assert s.state.show_palette
