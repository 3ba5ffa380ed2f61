"""Scenarios of `window_driver`: what is seen and done with mouse and keys."""

from dataclasses import replace
from pathlib import Path
from threading import Event
from types import SimpleNamespace
from typing import Any

import numpy as np
from PIL import Image

from langsplat_core.display.displays import SELECTED
from langsplat_core.extensions.library import panel as library_panel
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.inventory import Suggestions
from langsplat_core.semantics.features import ImageFeatures
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.camera.controls import from_side, pan
from langsplat_viewer.commands import COMMANDS
from langsplat_viewer.panels import select
from langsplat_viewer.panels.layout import INSPECTOR, TAKE_OUT, all_panels
from langsplat_viewer.panels.menus import button_label
from langsplat_viewer.panels.ui import scene_area
from langsplat_viewer.projects import thumbnail_of
from tests.support.fakes import CENTRES, PER_BLOB, as_trained, blob_scene, cameras, named_scene
from tests.support.windowless import answer, marked, result

from imgui_bundle import ImVec2, hello_imgui, imgui  # isort: skip
from imgui_bundle.glfw_utils import glfw_window_hello_imgui  # isort: skip
import glfw  # isort: skip


MUG, BOOK, PLANT = CENTRES


def split_the_view(s: Any) -> None:
    """The line is dragged without the camera; nothing is drawn for it, and nothing at rest."""
    rgb = s.shot("rgb")
    s.key("V")
    assert s.state.session.split.mode == "wipe"
    both, area, before = s.shot("both"), scene_area(), s.state.open.view
    np.testing.assert_allclose(s.at(both, MUG), s.at(rgb, MUG), atol=2)
    assert np.abs(s.at(both, PLANT) - s.at(rgb, PLANT)).max() > 40  # depth

    middle, y = area.left + area.width / 2, area.top + 0.8 * area.height
    drawn = s.drawn
    s.drag((middle, y), (area.left + 0.9 * area.width, y))
    assert abs(s.state.session.split.at - 0.9) < 0.02
    assert s.state.open.view is before
    assert s.drawn == drawn
    np.testing.assert_allclose(s.at(s.shot("wiped"), PLANT), s.at(rgb, PLANT), atol=2)

    s.drag((middle, y), (middle + 40, y))  # beside the line the camera turns as ever
    assert s.state.open.view is not before
    s.open_panel("Search")
    s.menu("View", "Three levels side by side")
    assert not s.ctx.item_exists("//**/##phrase")  # the search would cover two of them
    levels = s.shot("levels")
    assert s.drawn > drawn
    thirds = [levels[250:400, int(area.left + (i + 0.5) * area.width / 3)] for i in range(3)]
    assert np.abs(thirds[0] - thirds[2]).max() > 30
    s.draws_nothing()


def draw_over_the_scene(s: Any) -> None:
    """Axes and cameras are drawn, a click on a camera stands there, two clicks measure."""
    plain, area = s.shot("plain"), scene_area()
    s.menu("View", "Show or hide the axes")
    right = int(area.left + area.width)
    assert (s.shot("axes") != plain)[int(area.top) : int(area.top) + 75, right - 75 : right].any()
    s.menu("View", "Show or hide the training cameras")
    forward = from_side(s.state.open.view, "top").rotation[2]
    s.key("keypad7")
    np.testing.assert_allclose(s.state.open.view.rotation[2], forward, atol=1e-6)

    turn_the_wheel(s, 8)  # until all cameras are in the picture
    camera = s.state.open.scene.cameras[2]
    seen = s.shot("cameras")
    s.menu("View", "Show or hide the training cameras")
    assert np.abs(seen - s.shot("none"))[:, int(area.left) :].max() > 60
    s.menu("View", "Show or hide the training cameras")
    s.click_at(s.on_screen(camera.position))
    assert s.state.camera_index == 2
    got = s.state.open.view.camera(160, 120).world_to_camera
    np.testing.assert_allclose(got, camera.world_to_camera, atol=1e-9)

    s.key("M", frames=2)
    turned = s.state.open.view
    for thing in (MUG, BOOK):
        s.click_at(s.on_screen(thing))
    assert s.state.open.view is turned
    assert abs(s.state.session.ruler.length - np.linalg.norm(MUG - BOOK)) < 0.2
    s.ctx.mouse_double_click(0)  # two points in quick succession; elsewhere it would move the view
    s.settle()
    assert s.state.open.view is turned
    assert s.state.session.ruler.length is not None
    assert s.state.session.ruler.length < 0.05
    s.draws_nothing()
    s.key("escape", frames=2)
    assert not s.state.session.ruler.measures


def toasts_offer_what_follows(s: Any) -> None:
    """What was done is said over the scene, hidden panels or not, and undone from there."""
    s.window.toasts.seconds = 60.0
    s.search("mug")
    s.menu("Select", "Select what the search found")
    s.key("f11")
    plain = s.shot("plain")
    s.key("delete")
    assert marked(s.viewer) == ("", "", "mug")
    said = np.abs(s.shot("deleted") - plain)[500:600, 300:560]
    assert said.max() > 100
    s.click("//toasts/**/Undo")
    assert marked(s.viewer)[2] == ""
    s.key("P", frames=3)
    assert s.ctx.item_exists("//toasts/**/Show in folder")
    s.draws_nothing()
    s.window.toasts.seconds = 0.0
    s.rest(2)
    assert not s.ctx.item_exists("//toasts/**/Show in folder")
    s.window.toasts.seconds, foot = 60.0, imgui.internal.find_window_by_name("toasts")
    s.search("mugg", stay=True)
    assert answer(s, -1).problem  # the search says it
    assert not foot.active
    s.fold()
    queries.ask_listed(s.viewer)  # as when a project is opened
    s.settle()
    assert not foot.active
    for _ in range(2):
        queries.ask(s.viewer, "mugg")
        s.settle()
    assert foot.active
    assert len(s.window.toasts.shown) == 1  # the same is not said twice
    assert not s.ctx.item_exists("//toasts/**/Show in folder")  # of what was said before


def begin_at_the_start_page(s: Any) -> None:
    """Without a scene the page offers what was open lately, with thumbnails; nothing is drawn meanwhile."""
    blobs = s.folder / "blobs.ply"
    s.settle()
    assert s.state.show_start
    assert not s.ctx.item_exists("//**/##phrase")
    for key in ("tab", "tab", "enter"):  # the second button: Train from photographs
        s.key(key, frames=2)
    assert not s.state.show_start
    assert s.ctx.item_exists("//**/##Photographs")
    settings.prefer(s.viewer, recent=(str(blobs), str(s.folder / "gone.ply")))
    s.menu("File", "Start page")
    assert not s.ctx.item_exists("//start/2/###card")  # after the bundled scene and the one that is there
    assert s.drawn == 0
    warm = Event()
    begun = replace(s.viewer.services, warm_up=lambda *given: given[2]("compiling", 0.5) or warm.wait(60))
    s.viewer.services = begun
    s.click("//start/1/###card", frames=5)
    s.wait(lambda: s.ctx.item_exists("//start/compiling ..."))
    warm.set()
    s.until(lambda: s.state.path == blobs)
    assert not s.state.show_start
    assert s.ctx.item_exists("//**/##phrase")
    s.menu("File", "Start page")
    assert s.ctx.item_exists("//start/1/###card")
    s.draws_nothing()
    s.key("escape", frames=3)
    assert not s.state.show_start
    s.drop("plain.ply")
    assert np.asarray(Image.open(thumbnail_of(s.folder / "settings", blobs))).std() > 10


def offers_keep_still(s: Any) -> None:
    """Offers that come and go move nothing below them, and change under the pointer only by typing."""
    s.state.suggestions = Suggestions()
    s.rest(3)
    level = s.ctx.item_info("//**/Whole").rect_full.min.y
    s.state.suggestions = Suggestions(("mug", "book"), ("mug", "book", "bookcase"))
    s.rest(3)
    assert s.ctx.item_info("//**/Whole").rect_full.min.y == level
    s.ctx.mouse_move("//**/###offer 1")
    s.state.suggestions = Suggestions(("plant",))
    s.rest(3)
    s.click("//**/###offer 1")
    assert [query.phrase for query in s.state.session.queries] == ["book"]
    s.click_at((700, 500))
    assert not s.ctx.item_exists("//**/###offer 1")
    move_aside_for_what_is_covered(s)


def move_aside_for_what_is_covered(s: Any) -> None:
    """Once for every answer, so that a hand may bring it back below the search."""
    panel = imgui.internal.find_window_by_name("Search")
    viewpoint.move(s.viewer, lambda view: replace(view, distance=3 * view.distance))
    for _ in range(3):
        by = panel.pos + panel.size / 2 - ImVec2(*s.on_screen(BOOK))
        viewpoint.move(s.viewer, lambda view, by=by: pan(view, by.x, by.y, s.state.size))
    below = s.state.open.view
    s.search("book", stay=True)
    assert s.on_screen(BOOK)[0] > panel.pos.x + panel.size.x
    viewpoint.move(s.viewer, lambda view: below)
    s.rest(20)
    assert s.state.open.view is below


def turn_the_wheel(s: Any, times: int) -> None:
    """Away from the scene, over its middle."""
    area = scene_area()
    for _ in range(times):
        s.ctx.mouse_teleport_to_pos((area.left + area.width / 2, area.top + area.height / 2))
        s.ctx.mouse_wheel_y(-1)
        s.ctx.yield_(2)
    s.settle()


def look_without_perspective(s: Any) -> None:
    """A key takes perspective away until it is pressed again; the picture says what it is."""
    view = s.state.open.view
    s.key("O")
    assert s.state.open.view.orthographic
    flat, area = s.shot("flat"), scene_area()
    corner = (slice(int(area.top + area.height) - 40, None), slice(int(area.left), int(area.left) + 200))
    assert (flat[corner].min(-1) > 200).sum() > 100  # words
    s.key("keypad5")
    poses = [one.camera(160, 120).world_to_camera for one in (s.state.open.view, view)]
    np.testing.assert_allclose(*poses, atol=1e-9)


# Selecting.


def around(s: Any, centre: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two corners around a blob, as it is seen now."""
    x, y = s.on_screen(centre)
    right, _ = s.on_screen(centre + 0.6 * s.state.open.view.rotation[0])
    half = right - x
    return (x - half, y - half), (x + half, y + half)


def select_with_the_mouse(s: Any) -> None:
    """A rectangle, keys and buttons."""
    s.key("period")  # the camera in front: no blob hides another
    plain = s.shot("plain")
    s.menu("Window", "Selection")
    s.click("//**/Rectangle##tool")
    s.drag(*around(s, PLANT))
    seen = s.state.marks.selected
    assert 10 < seen.sum() < 110  # the front of it
    s.click("//**/Only what is visible")
    before = s.state.open.view
    s.drag(*around(s, PLANT))
    assert s.state.open.view is before  # the drag turned nothing
    assert marked(s.viewer) == ("plant", "", "")
    chosen = s.shot("chosen")
    colour = s.at(chosen, PLANT)
    assert np.abs(colour - 255 * np.array(SELECTED)).max() < 0.55 * 255  # it has the tint
    assert colour[2] > colour[1] + 60
    np.testing.assert_allclose(s.at(chosen, BOOK), s.at(plain, BOOK), atol=6)

    s.ctx.key_down(imgui.Key.mod_shift)
    s.drag(*around(s, BOOK))
    s.ctx.key_up(imgui.Key.mod_shift)
    assert marked(s.viewer)[0] == "book plant"

    s.key("H")
    assert marked(s.viewer) == ("", "book plant", "")
    s.key("escape", frames=3)
    assert s.state.tools.tool is None
    s.drag((600, 300), (656, 279))
    assert not np.array_equal(before.rotation, s.state.open.view.rotation)  # the drag turns again


def outline_and_rest(s: Any) -> None:
    """An outline is drawn while the button is held, Esc gives it up, and nothing is drawn again at rest."""
    s.menu("Select", "Select: lasso")
    s.ctx.mouse_teleport_to_pos((500, 200))
    s.ctx.mouse_down(0)
    for place in ((700, 200), (700, 400), (520, 390)):
        s.ctx.mouse_teleport_to_pos(place)
        s.ctx.yield_(2)
    assert len(s.state.tools.stroke.path) == 4
    line = s.shot("lasso")[196:205, 600]
    assert line.min(1).max() > 100  # a light line on black
    s.key("escape", frames=1)
    s.ctx.mouse_up(0)
    s.settle()
    assert (s.state.tools.stroke, s.state.tools.tool) == (None, "lasso")
    assert marked(s.viewer)[0] == ""
    s.draws_nothing()


def ask_before_leaving(s: Any) -> None:
    """What was deleted and not saved is asked about before another scene opens or the window closes."""
    s.search("mug")
    s.menu("Select", "Select what the search found")
    s.key("delete")
    assert marked(s.viewer) == ("", "", "mug")
    s.drop("plain.ply")
    s.click("//**/Cancel")
    assert s.state.path.name == "blobs.ply"

    s.menu("File", "Quit")
    assert not hello_imgui.get_runner_params().app_shall_exit
    s.click("//**/Cancel")
    assert not s.state.may_close
    glfw.set_window_should_close(glfw_window_hello_imgui(), True)  # its cross was clicked
    s.wait(lambda: s.state.leaving is not None)
    s.click("//**/Cancel")
    assert marked(s.viewer) == ("", "", "mug")

    s.drop("plain.ply")
    s.click("//**/Not saved/Save")
    s.shows("plain.ply")
    assert len(load_scene(s.folder / "blobs-edited-001.ply").gaussians) < 360
    assert len(load_scene(s.folder / "blobs.ply").gaussians) == 360  # as it was


def drag_the_gizmo(s: Any) -> None:
    """What was found is moved by the gizmo's middle; the camera stays."""
    viewer, before = s.viewer, s.state.open.scene.gaussians.means.copy()
    s.search("mug")
    editing.select_query(viewer)
    settings.set_display(viewer, "rgb")
    s.key("R")  # from where the view has moved aside
    s.open_panel("Transform", frames=1)
    s.key("G")
    view, chosen = s.state.open.view, s.state.marks.selected
    x, y = s.on_screen(editing.pivot(viewer, s.state.open))
    s.ctx.mouse_teleport_to_pos((x, y))
    for covered in (True, False):  # by a window over the scene, whose mouse it leaves alone
        viewer.state.show_help = covered
        s.ctx.yield_(3)
        assert select.holds_mouse(viewer) != covered
    with s.dragging((x, y), (x + 60, y - 120)):
        assert s.state.moving is not None
    s.settle()
    assert s.state.open.view is view
    moved = s.state.open.scene.gaussians.means - before
    assert (moved[~chosen] == 0).all()
    assert np.ptp(moved[chosen], axis=0).max() < 1e-5
    went = s.on_screen(editing.pivot(viewer, s.state.open))
    np.testing.assert_allclose(went, (x + 60, y - 120), atol=3)


def drag_the_crop_box(s: Any) -> None:
    """A corner of the box is dragged, and what lies outside is cropped."""
    s.open_panel("Transform", frames=1)
    s.click("//**/Box##gizmo", frames=2)  # around everything, as nothing is selected
    form, means = s.state.edit_form, s.state.open.scene.gaussians.means
    middle = np.mean([form.low, form.high], 0)
    start, end = np.array(s.on_screen(np.r_[form.low[:2], middle[2]])), np.array(s.on_screen(middle))
    s.drag(tuple(start), tuple(start + 0.8 * (end - start)))
    assert s.state.edit_form != form
    low, high = s.state.edit_form.low, s.state.edit_form.high
    inside = ((means >= low) & (means <= high)).all(1)
    s.click("//**/Crop")
    np.testing.assert_array_equal(s.state.marks.shown, inside)
    assert 0 < inside.sum() < len(means)


def use_the_mouse_alone(s: Any) -> None:
    """A threshold goes back, numbers are dragged, dialogs lead to folders, a small window shows the scene."""
    wide = s.state.size[0]
    s.search("mug")
    s.open_panel("Search", frames=3)
    s.click("//Search/Threshold, scores, place")
    queries.set_cut(s.viewer, "mug", 0.6)
    s.click("//Search/Auto##cut")
    assert s.state.session.queries[0].cut is None
    s.open_panel("Transform", frames=2)
    x, y = s.ctx.item_info("//**/Scale").rect_full.get_center()
    s.drag((x, y), (x + 60, y))
    assert s.state.edit_form.scale > 1.05
    s.drag((x - 30, y - 60), (x + 30, y - 60))  # the first number of "Move"
    assert 0.01 < s.state.edit_form.move[0] / s.state.open.extent.radius < 0.1
    stops, out, done = Event(), s.folder / "trained.ply", {f"stage {n}": 1.0 for n in range(200)}
    said, by = SimpleNamespace(stages=done, stage="", left="", curves={}, said=[]), stops.set
    training = SimpleNamespace(
        progress=said, out=out, exit_code=None, interrupt=by, end=by, interrupted=False
    )
    s.viewer.training = training
    s.open_panel("Train", frames=3)
    assert s.ctx.item_info("//**/Stop").rect_full.max.y < 620  # however much is done
    s.click("//**/Stop")
    assert stops.is_set()
    training.interrupted = True
    stops.clear()
    s.click("//**/Stop", frames=2)
    assert not stops.is_set()  # it is on its way
    s.viewer.training = None
    (s.folder / "within").mkdir()
    s.menu("File", "Open a scene ...")
    for name in ("within\\/", up := ".. (the folder above)", "blobs.ply", up, "plain.ply", "Open"):
        s.click(f"//**/{name}")
    s.shows("plain.ply")
    glfw.set_window_size(glfw_window_hello_imgui(), 400, 300)
    s.until(lambda: 200 < s.state.size[0] < 400)
    assert s.ctx.item_info("//**/Train one ...").rect_full.max.x < scene_area().corners[1].x
    for number in range(12):
        (s.folder / f"within {number}").mkdir()
    opening.ask_for_file(s.viewer)
    s.rest(4)
    assert s.ctx.item_info("//**/Cancel").rect_full.max.y < 300
    s.click("//**/Cancel")
    assert s.state.choice is None
    written = Event()
    s.viewer.recorder.submit("writing", lambda _: written.wait(60), lambda _: None, s.viewer.say_error)
    s.rest(4)
    assert imgui.internal.find_window_by_name("toasts").pos.x >= 0
    written.set()
    read_a_narrow_panel(s)
    s.open_panel("Timeline")
    assert s.ctx.item_info("//Timeline/Loop").rect_full.max.x < scene_area().corners[1].x
    glfw.set_window_size(glfw_window_hello_imgui(), 1040, 620)
    s.until(lambda: s.state.size[0] == wide)


def read_a_narrow_panel(s: Any) -> None:
    """A panel's rows lie below its header, and the help has no column of single letters."""
    settings.prefer(s.viewer, ui_scale=1.5)
    s.open_panel("Selection", frames=4)
    header, below = (s.ctx.item_info(f"//**/{name}").rect_full for name in ("Selection", "No tool"))
    assert header.max.y <= below.min.y
    settings.prefer(s.viewer, ui_scale=2.0)
    s.ctx.mouse_move("//**/Only what is visible")
    assert imgui.internal.find_window_by_name("##Tooltip_00").content_size.x < 400
    s.key("f1", frames=6)
    text = imgui.internal.find_window_by_name("Help").content_size
    assert text.x < 400
    assert text.y < 100 * imgui.get_text_line_height()
    s.key("escape", frames=2)
    settings.prefer(s.viewer, ui_scale=1.0)


def compare_two_scenes(s: Any) -> None:
    """Right of the line another scene is drawn by the same camera; without the line it is gone."""
    viewer, area = s.viewer, scene_area()
    s.search("mug")
    gaussians = blob_scene().gaussians
    dyed = replace(blob_scene(), path=None, gaussians=replace(gaussians, sh=-gaussians.sh))
    save_scene(s.folder / "other.ply", dyed)
    settings.set_display(viewer, "rgb")
    rgb = s.shot("rgb one")
    opening.open_beside(viewer, s.folder / "other.ply")
    s.wait(lambda: len(viewer.beside.state.session.queries) == 1 and viewer.beside.worker.current is None)
    settings.move_line(viewer, 0.5)
    both = s.shot("rgb two")
    middle = int(area.left + area.width / 2)
    assert (both == rgb)[100:450, 450 : middle - 8].all()
    assert np.abs(both - rgb)[100:450, middle + 8 :].max() > 60
    settings.compare(viewer, "off")
    assert (s.shot("rgb again") == rgb)[100:450, 450:].all()
    assert viewer.beside is None


def say_what_is_not_here(s: Any) -> None:
    """Nothing of it is told; beside another scene, on the side that it is not on."""
    viewer, there = s.viewer, s.folder / "mugs.ply"
    mugs = named_scene().take(np.arange(3 * PER_BLOB) < PER_BLOB)
    save_scene(there, replace(mugs, path=None))
    s.search("plant", stay=True)
    assert s.ctx.item_exists("//Search/Focus")
    assert not s.ctx.item_exists("//Search/Why?")  # nothing was trained here
    s.fold()
    opening.open_beside(viewer, there)
    s.wait(lambda: len(viewer.beside.state.session.queries) == 1 and viewer.beside.worker.current is None)
    area = scene_area()
    settings.move_line(viewer, 0.5)
    middle = int(area.top + area.height / 2)
    said = s.shot("beside")[middle - 8 : middle + 8, int(0.6 * area.width) : int(0.9 * area.width)]
    assert (said.min(-1) > 200).sum() > 50  # words
    settings.set_display(viewer, "depth")
    s.settle()
    left, right = map(imgui.internal.find_window_by_name, ("left legend", "legend"))
    assert left.active
    assert right.active
    s.window.toasts.seconds = 60.0
    viewer.state.say("what may be long: " * 9)
    s.settle()
    toast = imgui.internal.find_window_by_name("toasts")
    assert toast.pos.y + toast.size.y < left.pos.y  # which it would cover
    s.window.toasts.seconds = 0.0
    s.key("F")  # the plant, from which no mug is seen
    assert "nothing of the scene" in viewer.beside.state.nothing
    assert not right.active
    s.open_panel("Search")
    card, said = map(imgui.internal.find_window_by_name, ("Search", "side, right"))
    assert said.pos.x > card.pos.x + card.size.x or said.pos.y > card.pos.y + card.size.y
    s.fold()
    settings.set_display(viewer, "relevancy")
    settings.compare(viewer, "off")
    s.drop("mugs.ply")
    s.shows("mugs.ply")
    s.search("plant", stay=True)
    assert result(s, -1).verdict == "not here"
    assert not any(map(s.ctx.item_exists, ("//Search/Focus", "//Search/Why?")))


def pin_a_note(s: Any) -> None:
    """What is typed after the click is its text; it is kept in the project."""
    s.key("N", frames=2)
    s.click_at(s.on_screen(BOOK))
    s.wait(lambda: imgui.get_io().want_text_input)
    s.ctx.key_chars("lent by Ada")
    s.key("escape", frames=2)
    (note,) = s.state.session.notes
    assert (note.text, s.state.pins_notes) == ("lent by Ada", False)
    assert np.linalg.norm(note.at - BOOK) < 1.0
    assert glfw.get_window_title(glfw_window_hello_imgui()).startswith("*blobs.ply")
    s.key("Ctrl+S", frames=3)
    s.key("enter")
    s.until((s.folder / "blobs-001.langsplat").exists)
    assert glfw.get_window_title(glfw_window_hello_imgui()).startswith("blobs.ply")


def export_from_the_menu(s: Any) -> None:
    """A dialog asks for format and file, and says the size first; the scene is written meanwhile."""
    s.ctx.item_click("//**/##MenuBar/File")
    s.ctx.item_click("//$FOCUSED/Export")
    s.click("//**/Scene ...")
    s.click("//Export/.spz")
    s.shot("export")
    s.click("//Export/Export ...", frames=4)
    s.key("enter", frames=2)
    assert s.viewer.recorder.current is not None
    s.until((s.folder / "blobs-scene-001.spz").exists)
    assert len(load_scene(s.folder / "blobs-scene-001.spz").gaussians) == 360
    for leave in (lambda: s.click("//Export/Cancel"), lambda: s.key("escape", frames=3)):
        saving.ask_export(s.viewer, "mesh")
        s.rest(3)
        leave()
        assert s.state.export_form is None


def reload_what_changed(s: Any) -> None:
    """A bar appears by itself, its button reads the file again."""
    before = s.state.open.scene
    assert not s.ctx.item_exists("//changed/Reload")
    scene = replace(blob_scene(), path=None)
    save_scene(s.state.path, replace(scene, gaussians=replace(scene.gaussians, sh=-scene.gaussians.sh)))
    s.until(lambda: s.viewer.watch.changed)
    s.ctx.item_click("//changed/Reload")
    s.until(lambda: s.state.open.scene is not before)
    assert not s.ctx.item_exists("//changed/Reload")


def see_the_evidence(s: Any) -> None:
    """The sheet lies in a window over the scene, until that is closed."""
    scene = blob_scene()
    seen = ImageFeatures(np.zeros((3, 120, 160), np.int32), np.eye(1, 8, dtype=np.float32))
    as_trained(s.state.path, scene, [seen] * len(scene.cameras))
    s.search("mug", stay=True)
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


def search_a_library(s: Any) -> None:
    """The panel lists the scenes of a folder; a phrase ranks them, a click opens one and asks it there."""
    viewer = s.viewer
    save_scene(s.folder / "deep" / "named.ply", replace(named_scene(), path=None))
    fewer = named_scene().take(np.arange(3 * PER_BLOB) < PER_BLOB)
    save_scene(s.folder / "deep" / "mug.ply", replace(fewer, cameras=cameras()))
    s.open_panel("Library", frames=3)
    s.click("//**/Folder ...", frames=4)
    s.enter("deep")
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


# Where things lie: large letters, long words.

LONG = "mugg or boook or plent or mugg or boook or plent or mugg or boook or plent or mugg"


def large_letters(s: Any) -> None:
    """At twice the size, in a small window: the column grows, and no widget of any panel is cut off."""
    for phrase in ("mug or plant", LONG):
        s.search(phrase, stay=True)
    assert answer(s, -1).meant  # a long one, and so is the button for it
    narrow = s.state.size[0]
    settings.prefer(s.viewer, ui_scale=2.0)
    s.settle()
    wide = s.state.size[0]
    assert 0.63 * 1280 < wide < narrow - 50
    for panel in all_panels():
        s.open_panel(panel.title)
        items = imgui.test_engine.TestItemList()
        s.ctx.gather_items(items, f"//{panel.title if panel.dock != INSPECTOR else INSPECTOR}")
        assert items.get_size() > 0, panel.title
        for item in map(items.get_by_index, range(items.get_size())):
            assert item.rect_full.max.x <= item.window.inner_rect.max.x + 1, panel.title
    for scale, show, name in (
        (2.0, lambda viewer: settings.put(viewer.state, show_help=True), "Help"),
        (3.0, settings.toggle_palette, "Commands"),
        (3.0, opening.ask_for_file, "###choice"),
    ):
        settings.prefer(s.viewer, ui_scale=scale)
        show(s.viewer)
        s.settle()
        over = s.ctx.window_info(f"//{name}").window
        assert 0 <= over.pos.x <= over.pos.x + over.size.x <= 1280, name
        assert 0 <= over.pos.y <= over.pos.y + over.size.y <= 720, name
        settings.escape(s.viewer)
    s.ctx.dock_into("Messages", "Inspector", imgui.Dir.down)  # by hand, which it survives
    docked = imgui.internal.find_window_by_name("Messages").dock_id
    settings.prefer(s.viewer, ui_scale=1.0)
    s.settle()
    assert imgui.internal.find_window_by_name("Messages").dock_id == docked
    assert abs(s.state.size[0] - narrow) < 0.15 * narrow
    settings.prefer(s.viewer, panels=("Display",))
    s.search("mug or plant", stay=True)
    card, legend = map(imgui.internal.find_window_by_name, ("Search", "legend"))
    for scale, fits in ((2.0, False), (1.5, True)):  # beside the search
        settings.prefer(s.viewer, ui_scale=scale)
        s.settle()
        assert legend.active == fits
    assert card.pos.x + card.size.x <= legend.pos.x
    settings.toggle_wipe(s.viewer)  # depth is right of the line, heat left of it: a legend in each
    s.settle()
    low, left = legend.size.y, imgui.internal.find_window_by_name("left legend")
    assert left.pos.x + left.size.x <= scene_area().left + 0.5 * scene_area().width <= legend.pos.x
    s.open_panel("Timeline")  # the search reaches down to where the left one was
    assert not left.active
    assert legend.size.y > 1.5 * low
    assert card.pos.x + card.size.x <= legend.pos.x
    settings.set_display(s.viewer, "latent")
    s.until(lambda: s.state.outline is not None and len(s.state.outline.roots) > 0)
    assert legend.size.y > 1.5 * low  # things and depth


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
    s.key("f2", frames=6)  # names what is selected
    s.enter("my first")
    assert (result(s, -1).phrase, s.state.drafts.get("##phrase", "")) == ("my first", "")
    s.key("escape", frames=3)
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
    """Keyframes by a key, played in the window until the hand takes over."""
    record = s.state.record
    s.open_panel("Timeline", frames=4)
    for end in ((656, 300), (700, 320)):
        s.key("K", frames=1)
        s.drag((600, 300), end)
    s.click("//Timeline/Add keyframe", frames=2)
    assert [key.seconds for key in s.state.session.keyframes] == [0, 2, 4]
    last = s.state.open.view
    viewpoint.set_path_seconds(s.viewer, 1.0)
    s.ctx.item_click("//Timeline/Play##path")
    s.wait(lambda: record.began is None)
    np.testing.assert_allclose(s.state.open.view.eye, last.eye, atol=1e-6)
    viewpoint.set_path_seconds(s.viewer, 60.0)  # longer than a frame may take
    s.key("Shift+K", frames=1)  # from the start again
    s.wait(lambda: 0 < record.at < 59.0)
    s.drag((600, 300), (620, 310))
    assert record.began is None


# Keys, palette, toolbar, and where panels lie.


def use_shortcuts(s: Any) -> None:
    """Chords work everywhere, letters only by themselves and never while typing."""
    before = s.state.open.view
    for key in "RPD2E":
        s.key(f"Ctrl+{key}", frames=3)
    assert s.state.open.view is before
    assert s.state.session.picture.display == "rgb"
    assert not list(s.folder.glob("blobs-*.png"))

    s.key("Ctrl+F", frames=3)
    s.type("far", frames=3)
    assert (s.state.drafts["##phrase"], s.state.open.view is before) == ("far", True)
    s.key("f1", frames=2)  # also while typing
    assert s.state.show_help
    s.key("f1", frames=1)
    s.key("escape", frames=3)
    assert not imgui.get_io().want_text_input
    assert not s.state.show_help
    s.key("Shift+F")
    assert s.state.open.view is not before
    s.key("home")
    first = s.state.open.scene.cameras[0].world_to_camera
    np.testing.assert_allclose(s.state.open.view.camera(160, 120).world_to_camera, first, atol=1e-9)

    s.type("?")
    assert s.state.show_help
    s.key("escape", frames=1)
    s.key("Ctrl+O", frames=3)
    s.enter("plain.ply")
    s.shows("plain.ply")


class FakeDialog:
    """A dialog of the system that is open until it is answered or killed."""

    answer: list[str] | None = None
    killed = False

    def ready(self, timeout: int) -> bool:
        return self.answer is not None

    def result(self) -> list[str]:
        return self.answer

    def kill(self) -> None:
        self.killed, self.answer = True, []


def choose_in_the_systems_dialog(s: Any) -> None:
    """Frames go on while the dialog is open; what is chosen opens, Esc closes the dialog."""
    shown: list[FakeDialog] = []
    s.window.files.open_system = lambda choice: shown.append(FakeDialog()) or shown[-1]
    s.menu("File", "Open a scene ...")
    s.ctx.yield_(20)
    assert not s.ctx.item_exists("//**/##path")
    shown[0].answer = [str(s.folder / "plain.ply")]
    s.shows("plain.ply")
    s.key("Ctrl+O", frames=3)
    s.key("escape", frames=3)
    assert (shown[1].killed, s.state.choice) == (True, None)
    s.key("Ctrl+O", frames=3)
    shown[2].answer = []  # its own Cancel
    s.until(lambda: s.state.choice is None)
    assert s.state.path.name == "plain.ply"
    s.draws_nothing()


def use_the_toolbar(s: Any) -> None:
    """Every icon does what its command does, however low the strip is."""
    s.open_panel("Timeline")
    labels = {row.does: button_label(row).replace("/", "\\/") for row in COMMANDS if row.icon}
    icons = {does: f"//Tools/{label}" for does, label in labels.items()}
    for does, icon in icons.items():
        info = s.ctx.item_info(icon)
        assert info.window.inner_rect.max.y >= info.rect_full.max.y, does  # is not cut off
    s.ctx.item_click(icons["show depth"])
    s.click(icons["select: lasso"], frames=2)
    assert (s.state.session.picture.display, s.state.tools.tool) == ("depth", "lasso")
    s.ctx.item_click(icons["select with no tool: the left button turns the view"])


def many_queries(s: Any) -> None:
    """However many there are and however long: the list keeps its place, the newest is on top."""
    display = s.ctx.item_info("//**/Colours").rect_full.min.y
    long = "a mug or a book or a plant or another mug or plant"
    for phrase in ("mug", "plant", "book or plant", long, "pot"):
        s.search(phrase)
        assert s.ctx.item_info("//**/Colours").rect_full.min.y == display
    phrase = s.state.session.queries[-1].phrase
    s.click(f"//**/{phrase}/x", frames=2)
    assert phrase not in [query.phrase for query in s.state.session.queries]
    assert s.ctx.item_info("//**/Colours").rect_full.min.y == display


def arrange_panels(s: Any) -> None:
    """Menus do what keys do; panels are closed, opened and raised, and come back as they were."""
    s.menu("View", "Show depth")
    assert s.state.session.picture.display == "depth"
    s.menu("Window", "Light theme, or dark again")
    assert s.shot("light")[540, 1035].min() > 150
    whole = s.state.size
    for title in ("Timeline", "Messages"):  # tabs of one place
        s.menu("Window", title)
    assert s.state.size[1] < whole[1] - 100
    assert not s.ctx.item_exists("//Timeline/Add keyframe")
    s.menu("Window", "Timeline")  # from behind the other
    assert s.ctx.item_exists("//Timeline/Add keyframe")
    for title in ("Timeline", "Messages", "Display", "Search"):
        s.menu("Window", title)
    assert s.state.size == whole  # the scene has taken their place
    assert not s.ctx.item_exists("//**/Colours")
    s.key("Ctrl+F", frames=4)
    s.type("mug", frames=3)
    assert s.state.drafts["##phrase"] == "mug"  # the panel is open again, and its box has the keyboard
    s.key("escape", frames=1)
    s.menu("Window", "Reset the layout")
    assert s.state.size == whole
    s.click(f"//Inspector/{TAKE_OUT}##Display")
    assert s.ctx.item_exists("//Display/Colours")
    s.ctx.dock_into("Display", "Inspector", imgui.Dir.down)
    s.menu("Window", "Reset the layout")
    assert s.ctx.item_exists("//Inspector/**/Colours")


def leave_settings(s: Any) -> None:
    """The next window finds them; see `find_settings`."""
    assert s.state.show_help  # at the first start
    s.key("escape", frames=1)
    s.menu("Window", "Light theme, or dark again")
    for title in ("Selection", "Timeline", "Display"):
        s.menu("Window", title)
    s.key("f11")  # hidden at the end, there again the next time
    assert s.state.size[0] == 1040


def find_settings(s: Any) -> None:
    """Return what `leave_settings` has left."""
    assert not s.state.show_help
    assert s.state.preferences.theme == "light"
    assert [Path(path).name for path in s.state.preferences.recent] == ["blobs.ply"]
    assert s.state.size[1] < 480  # above the timeline
    assert s.ctx.item_exists("//**/##phrase")
    assert s.ctx.item_exists("//**/Rectangle##tool")
    assert not s.ctx.item_exists("//**/Colours")


def travel_by_keys(s: Any) -> None:
    """Esc closes a menu; Tab goes from field to field, and the panels stay; the palette knows everything."""
    editing.use_tool(s.viewer, "lasso")
    s.ctx.item_click("//**/##MenuBar/View")
    assert imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    s.key("escape", frames=2)
    assert not imgui.is_popup_open("", imgui.PopupFlags_.any_popup)
    s.key("Ctrl+F", frames=4)
    s.key("escape", frames=3)
    s.key("Ctrl+F", frames=4)
    seen = set()
    for _ in range(12):
        s.key("tab", frames=2)
        seen.add(imgui.internal.get_focus_id())
    assert len(seen) > 5
    assert s.state.show_panel
    s.state.preferences = s.state.preferences.with_recent(s.folder / "plain.ply")
    for words, done in (
        ("light theme", lambda: s.state.preferences.theme == "light"),
        ("larger text", lambda: s.state.preferences.ui_scale == 1.25),
        ("open plain", lambda: s.state.path.name == "plain.ply"),
    ):
        s.key("Ctrl+Shift+P", frames=3)
        s.ctx.key_chars_append_enter(words)
        s.until(done)
    s.key("Ctrl+Shift+P", frames=3)
    s.type("show")  # arrows choose another command than the first
    for _ in range(3):
        s.key("down_arrow", frames=2)
    s.key("enter", frames=3)
    assert s.state.session.picture.display == "depth"
    for begin in (lambda: s.click_at((650, 500)), lambda: s.open_panel("Display", frames=3)):
        begin()  # in the view, or in a panel
        focused = imgui.internal.get_focus_id()
        for key in ("Ctrl+Shift+P", "f1"):
            s.key(key, frames=3)
            s.key("escape", frames=4)
            assert imgui.internal.get_focus_id() == focused
    assert s.state.tools.tool == "lasso"


def do_without_a_mouse(s: Any) -> None:
    """Tab leads to a field from the first frame on, and from where something is gone."""
    s.key("tab", frames=3)
    assert imgui.get_io().want_text_input  # the box of the search
    s.key("escape", frames=2)
    for name in ("one", "two"):
        viewpoint.add_bookmark(s.viewer, name)
    s.open_panel("Bookmarks", frames=3)
    for _ in range(7):  # to what takes the second off
        s.key("tab", frames=2)
    s.key("space", frames=3)
    assert [mark.name for mark in s.state.session.bookmarks] == ["one"]
    s.key("tab", frames=4)
    assert imgui.internal.get_focus_id() == s.ctx.item_info("//Inspector/Display").id_
    s.open_panel("Search", frames=3)
    assert imgui.get_current_context().nav_window.name == "Search"
    s.key("f1", frames=3)
    s.click("//Help/pages/Keys", frames=2)
    top = imgui.internal.find_window_by_name("Help").scroll.y
    s.key("page_down", frames=3)
    assert imgui.internal.find_window_by_name("Help").scroll.y > top + 100
    s.key("escape", frames=2)
    click_with_a_key(s)
    turn_with_keys(s)


def click_with_a_key(s: Any) -> None:
    """X clicks the middle of the image, for the ruler, a note and a tool, and to turn around it."""
    queries.ask(s.viewer, "plant")
    s.settle()
    s.key("F")
    s.key("M", frames=2)
    s.key("X")
    viewpoint.move(s.viewer, lambda view: pan(view, 10, 0, s.state.size))
    s.settle()
    s.key("X")
    assert 0 < s.state.session.ruler.length < 0.5
    s.key("N", frames=2)
    s.key("X")
    s.wait(lambda: imgui.get_io().want_text_input)
    s.type("a fern")
    s.key("escape", frames=2)
    (note,) = s.state.session.notes
    assert note.text == "a fern", note.text
    assert np.linalg.norm(note.at - PLANT) < 0.5
    s.key("escape", frames=2)
    before = s.state.open.view
    s.key("X")
    assert s.state.open.view.distance < before.distance  # the surface, not the middle of the plant
    editing.use_tool(s.viewer, "thing")
    s.key("X")
    assert marked(s.viewer)[0] == "plant"
    s.key("escape", frames=2)


def turn_with_keys(s: Any) -> None:
    """The keypad turns around the centre and goes nearer; the line of a comparison is moved by a number."""
    before = s.state.open.view
    for key in (imgui.Key.keypad6, imgui.Key.keypad_add):
        s.ctx.key_down(key)
        s.ctx.yield_(8)
        s.ctx.key_up(key)
    np.testing.assert_allclose(s.state.open.view.target, before.target)
    assert s.state.open.view.distance < before.distance
    assert s.state.open.view.rotation[2] @ before.rotation[2] < 0.9999
    s.key("V")
    s.open_panel("Display")
    s.ctx.item_input_value("//**/Line", 0.25)
    s.settle()
    assert s.state.session.split.at == 0.25
