"""Scenarios of `window_driver` in the panels: files, training, layout, recording, bookmarks."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
from PIL import Image

from imgui_bundle import imgui  # isort: skip
from langsplat_core.io.scenes import save_scene
from langsplat_core.semantics.store import ImageFeatures
from langsplat_viewer import viewer as training
from langsplat_viewer.actions import browsing, filming, opening, selecting, settings, viewpoint
from langsplat_viewer.files.projects import read_flight
from langsplat_viewer.panels.layout import PANELS
from langsplat_viewer.panels.ui import scene_area
from tests.support.fakes import CENTRES, PER_BLOB, as_trained, blob_scene, cameras, named_scene


def reload_what_changed(s: Any) -> None:
    """A bar appears by itself, its button reads the file again, camera and queries stay."""
    s.search("mug")
    s.drag((600, 300), (656, 279))
    s.settle()
    view, before = s.state.view, s.state.scene
    assert not s.ctx.item_exists("//changed/Reload")
    scene = replace(blob_scene(), path=None)
    save_scene(s.state.path, replace(scene, gaussians=replace(scene.gaussians, sh=-scene.gaussians.sh)))
    s.wait(lambda: s.window.viewer.watch.changed)
    s.ctx.yield_(3)
    s.shot("changed")
    s.ctx.item_click("//changed/Reload")
    s.wait(lambda: s.state.scene is not before)
    s.settle()
    assert s.state.view is view
    assert s.state.queries[0].result.found
    assert not s.ctx.item_exists("//changed/Reload")
    hot = s.at(s.shot("reloaded"), CENTRES[0])
    assert hot[0] > hot[2] + 60


def fade_in_a_photograph(s: Any) -> None:
    """The slider lays it over the picture where the camera saw it; elsewhere there is none."""
    viewer, folder = s.window.viewer, s.folder / "elsewhere"
    folder.mkdir()
    colours = np.full((240, 320, 3), (250, 120, 10), np.uint8)
    colours[:, 160:] = (20, 60, 240)
    Image.fromarray(colours).save(folder / "photo_1.png")
    settings.open_panel(s.window.viewer, "Camera")
    viewpoint.go_to_camera(viewer, 1)
    s.settle()
    plain = s.shot("plain")
    opening.fade_photograph(viewer, 1.0)
    s.settle()
    s.ctx.yield_(3)
    assert "no photograph 'photo_1'" in s.state.photograph.reason
    assert (s.shot("none")[100:500, 400:] == plain[100:500, 400:]).all()
    s.click("//Camera/Folder of photographs ...", frames=4)
    s.click("//**/elsewhere\\/", frames=4)
    s.shot("browser")
    s.ctx.item_click("//**/Take this folder")
    s.wait(lambda: s.state.photograph.image is not None)
    s.settle()
    assert list(s.state.preferences.photographs.values()) == [str(folder.absolute())]
    area, shot = scene_area(), s.shot("photograph")
    middle, left = int(area.top + area.height / 2), int(area.left)
    quarter = int(area.width / 4)
    np.testing.assert_allclose(shot[middle, left + quarter], (250, 120, 10), atol=3)
    np.testing.assert_allclose(shot[middle, left + 3 * quarter], (20, 60, 240), atol=3)
    assert (shot[int(area.top) + 30, left + quarter] == plain[int(area.top) + 30, left + quarter]).all()
    opening.fade_photograph(viewer, 0.5)
    s.ctx.yield_(3)
    half = s.shot("half")
    place = middle, left + quarter
    np.testing.assert_allclose(half[place], (shot[place] + plain[place]) / 2, atol=4)
    s.drag((600, 300), (656, 279))
    s.settle()
    assert opening.photograph_here(s.state) is None


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
    s.window.drop([str(s.folder / name) for name in ("blobs.ply", "plain.ply")])
    s.ctx.yield_(2)
    s.settle()
    assert [path.name for path in s.state.scenes] == ["blobs.ply", "plain.ply"]
    s.drag((600, 300), (656, 279))
    s.settle()
    view = s.state.view
    s.shot("listed")
    s.ctx.item_click("//**/plain.ply##scene")
    s.wait(lambda: s.state.path.name == "plain.ply")
    s.settle()
    assert s.state.view is not view
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.page_up)
    s.wait(lambda: s.state.path.name == "blobs.ply")
    s.settle()
    assert s.state.view is view
    s.key(imgui.Key.mod_ctrl | imgui.Key.o, frames=4)
    s.shot("all of them")
    s.click("//**/Open all scenes here", frames=3)
    s.settle()
    assert s.state.path.name == "blobs.ply"


def search_a_library(s: Any) -> None:
    """The panel lists the scenes of a folder; a phrase ranks them, a click opens one and asks it there."""
    viewer = s.window.viewer
    save_scene(s.folder / "deep" / "named.ply", replace(named_scene(), path=None))
    fewer = named_scene().take(np.arange(3 * PER_BLOB) < PER_BLOB)
    save_scene(s.folder / "deep" / "mug.ply", replace(fewer, cameras=cameras()))
    s.open_panel("Library", frames=3)
    s.click("//Library/Folder ...", frames=4)
    viewer.state.path_typed = "deep"
    browsing.open_typed(viewer)
    s.ctx.yield_(3)
    s.ctx.item_click("//**/Take this folder")
    s.wait(lambda: s.state.library is not None)
    s.settle()
    assert len(s.state.library.hits) == 2
    s.shot("library")
    browsing.ask_library(viewer, "plant")
    s.wait(lambda: s.state.library.phrase == "plant")
    s.settle()
    assert [hit.path.name for hit in s.state.library.hits] == ["named.ply", "mug.ply"]
    assert [hit.verdict for hit in s.state.library.hits] == ["found", "not here"]
    s.shot("ranked")
    s.ctx.item_click("//**/$$0/##scene")
    s.wait(lambda: s.state.path.name == "named.ply")
    s.settle()
    assert s.state.queries[0].phrase == "plant"
    assert s.state.queries[0].result.found


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
    viewer, photographs = s.window.viewer, s.folder / "photos"
    photographs.mkdir()
    for number in range(3):
        (photographs / f"{number}.jpg").write_bytes(b"")
    training.command = lambda request: [sys.executable, "-c", TRAINS]
    browsing.choose_photographs(viewer, photographs)
    s.open_panel("Train", frames=3)
    s.ctx.item_click("//Train/Train")
    s.wait(lambda: viewer.training is not None and len(viewer.training.progress.losses) > 50)
    s.ctx.yield_(3)
    before = s.shot("loss")
    plot = s.ctx.item_info("//Train/##loss").rect_full
    inside = before[int(plot.min.y) : int(plot.max.y), int(plot.min.x) : int(plot.max.x)]
    assert inside.max() - inside.min() > 60
    s.ctx.item_click("//Train/Stop")
    s.wait(lambda: viewer.training is None)
    assert "training stopped" in s.state.messages[-1].text


# Scenarios of `window_driver` about where things lie: large letters, long words.

LONG = "mugg or boook or plent or mugg or boook or plent or mugg or boook or plent or mugg"


def large_letters(s: Any) -> None:
    """At twice the size, in a small window: the column grows, and no widget of any panel is cut off."""
    for phrase in ("mug or plant", LONG):
        s.search(phrase)
    assert s.state.queries[-1].meant  # a long one, and so is the button for it
    narrow = scene_area().left
    settings.set_ui_scale(s.window.viewer, 2.0)
    s.settle()
    assert 1.3 * narrow < scene_area().left <= 0.41 * 1280
    for panel in PANELS:
        s.open_panel(panel.title)
        assert seen_items(s, panel.title), panel.title
        assert cut_off(s, panel.title) == [], panel.title
    s.window.viewer.state.show_help = True
    s.settle()
    keys = s.ctx.window_info("//Help").window
    assert 0 <= keys.pos.x <= keys.pos.x + keys.size.x <= 1280
    assert 0 <= keys.pos.y <= keys.pos.y + keys.size.y <= 720
    s.shot("large letters")
    settings.escape(s.window.viewer)
    settings.set_ui_scale(s.window.viewer, 3.0)
    for show, name in ((settings.toggle_palette, "Commands"), (browsing.ask_for_file, "Open a scene")):
        show(s.window.viewer)
        s.ctx.yield_(4)
        over = s.ctx.window_info(f"//{name}").window
        assert (over.pos.x, over.pos.y) >= (0, 0)
        assert over.pos.x + over.size.x <= 1280
        assert over.pos.y + over.size.y <= 720
        settings.escape(s.window.viewer)
        s.ctx.yield_(2)
    settings.set_ui_scale(s.window.viewer, 1.0)
    s.settle()
    assert abs(scene_area().left - narrow) < 0.15 * narrow


def seen_items(s: Any, title: str) -> list[Any]:
    """The widgets of a panel."""
    found = imgui.test_engine.TestItemList()
    s.ctx.gather_items(found, f"//{title}")
    return [found.get_by_index(place) for place in range(found.get_size())]


def cut_off(s: Any, title: str) -> list[tuple[float, float]]:
    """Right ends of the widgets that reach beyond their window, and where that ends."""
    ends = [(item.rect_full.max.x, item.window.inner_rect.max.x) for item in seen_items(s, title)]
    return [(right, end) for right, end in ends if right > end + 1]


def use_the_outline(s: Any) -> None:
    """Rows are clicked, hidden, locked and dragged onto each other; the menu of a thing names it."""
    s.search("mug")
    settings.open_panel(s.window.viewer, "Outline")
    s.wait(lambda: s.state.outline is not None and len(s.state.outline.roots) > 0)
    s.settle()
    first, second = s.state.outline.roots[:2]
    rows = "//**/node "
    s.click(f"{rows}{first.node}/###row")
    chosen = s.state.selection.marks.selected
    assert (chosen == s.state.outline.tree.members(first.node)).all()
    s.click(f"{rows}{first.node}/###eye")
    assert (s.state.selection.marks.hidden == chosen).all()
    s.click(f"{rows}{first.node}/###eye")
    s.click(f"{rows}{first.node}/###lock", frames=2)
    assert s.state.things.locked == {first.node}
    s.shot("outline")
    s.ctx.item_drag_and_drop(f"{rows}{first.node}/###row", f"{rows}{second.node}/###row")
    s.ctx.yield_(2)
    (group,) = s.state.things.groups
    assert group.nodes == (second.node, first.node)
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.z, 2)
    s.settle()
    assert (s.state.things.locked, s.state.things.groups) == (set(), ())

    use_the_outline_by_keys(s, first.node)
    s.key(imgui.Key.r)
    area, (width, height) = scene_area(), s.state.size
    (x, y), _ = (part[0] for part in s.state.view.camera(width, height).project(CENTRES[1][None]))
    s.ctx.mouse_move_to_pos((x + area.left, y + area.top))
    s.ctx.yield_(2)
    s.ctx.mouse_click(1)
    s.ctx.yield_(3)
    s.ctx.item_click("//**/##name this")
    s.enter("the atlas")
    assert s.state.queries[-1].phrase == "the atlas"
    assert s.state.queries[-1].result.members.reshape(3, -1).all(1).tolist() == [False, True, False]


def use_the_outline_by_keys(s: Any, node: int) -> None:
    """From the filter down to a row: Enter looks at the thing, the menu key groups it."""
    settings.open_panel(s.window.viewer, "Outline")
    selecting.select_none(s.window.viewer)
    s.ctx.item_click("//**/##filter")
    s.key(imgui.Key.down_arrow, frames=2)
    s.key(imgui.Key.enter)
    assert (s.state.selection.marks.selected == s.state.outline.tree.members(node)).all()
    s.key(imgui.Key.menu, frames=3)
    s.ctx.key_press(imgui.Key.up_arrow)  # to the last
    s.ctx.yield_(2)
    s.key(imgui.Key.enter, frames=3)
    assert [group.nodes for group in s.state.things.groups] == [(node,)]
    s.key(imgui.Key.mod_ctrl | imgui.Key.z)


# Scenarios of `window_driver`: the panel "Record", bookmarks, sides.


def record_and_play(s) -> None:
    """Keyframes by a key, played in the window, saved as a path and as a film."""
    record = s.state.record
    s.open_panel("Record", frames=4)
    for end in ((656, 300), (700, 320)):
        s.ctx.key_press(imgui.Key.k)
        s.drag((600, 300), end)
        s.settle()
    s.click("//Record/Add keyframe", frames=2)
    assert [key.seconds for key in record.keyframes] == [0, 2, 4]
    last = s.state.view
    s.ctx.item_click("//Record/Clear")
    s.key(imgui.Key.mod_ctrl | imgui.Key.z, frames=2)
    assert len(record.keyframes) == 3

    filming.set_path_seconds(s.window.viewer, 60.0)  # longer than a frame may take
    start = s.shot("start")
    s.ctx.item_click("//Record/Play##path")
    s.wait(lambda: 0.2 < record.at < 60.0)
    moving = s.state.view
    filming.set_path_seconds(s.window.viewer, 1.0)
    s.ctx.item_click("//Record/Play##path")
    s.wait(lambda: record.began is None)
    assert record.at == 1.0
    np.testing.assert_allclose(s.state.view.eye, last.eye, atol=1e-6)
    assert np.abs(moving.eye - last.eye).max() > 1e-3
    filming.set_path_seconds(s.window.viewer, 60.0)
    s.ctx.key_press(imgui.Key.mod_shift | imgui.Key.k)  # from the start again
    s.wait(lambda: 0 < record.at < 59.0)
    s.drag((600, 300), (620, 310))  # the hand is stronger
    s.settle()
    assert record.began is None
    assert np.abs(s.shot("elsewhere") - start)[100:500, 400:].max() > 30

    s.click("//Record/Save path", frames=2)
    assert len(read_flight(s.folder / "blobs-001.path.json").keyframes) == 3
    filming.set_path_seconds(s.window.viewer, 1.0)
    filming.set_film_size(s.window.viewer, 32, 24)
    s.window.viewer.state.record.fps = 4.0
    s.window.viewer.state.record.film_typed = "film"
    s.ctx.item_click("//Record/Save film")
    s.wait(lambda: s.window.viewer.recorder.current is None)
    s.ctx.yield_(3)
    assert len(list((s.folder / "film").glob("frame-*.png"))) == 5


def mark_and_return(s) -> None:
    """A bookmark by its key, the sides by theirs, the command on the clipboard."""
    s.key(imgui.Key.mod_ctrl | imgui.Key.b, frames=2)
    start = s.state.view
    s.key(imgui.Key.keypad7)
    np.testing.assert_allclose(s.state.view.rotation[2], -start.up, atol=1e-6)
    s.open_panel("Bookmarks", frames=4)
    s.click("//**/view 1##bookmark")
    np.testing.assert_allclose(s.state.view.rotation, start.rotation, atol=1e-6)
    s.ctx.item_click("//**/##bookmark")
    s.enter("by the key of k", frames=2)
    assert [mark.name for mark in s.state.bookmarks] == ["view 1", "by the key of k"]
    assert s.state.record.keyframes == ()
    s.key(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.c, frames=3)
    assert imgui.get_clipboard_text().startswith("langsplat-viewer ")
