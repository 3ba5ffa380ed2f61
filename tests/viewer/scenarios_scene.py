"""Scenarios of `window_driver` over the scene: several panes, overlays, measuring, selecting."""

from dataclasses import replace
from itertools import combinations, product
from typing import Any

import numpy as np
from PIL import Image

from tests.support.windowless import result

from imgui_bundle import hello_imgui, imgui  # isort: skip
from imgui_bundle.glfw_utils import glfw_window_hello_imgui  # isort: skip
import glfw  # isort: skip
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_viewer.actions import editing, opening, settings, viewpoint
from langsplat_viewer.camera.controls import from_side
from langsplat_viewer.camera.overlays import PlacedText
from langsplat_viewer.panels import overlays, select
from langsplat_viewer.panels.ui import Area, scene_area
from langsplat_viewer.rendering.request import TINT
from langsplat_viewer.state import EditForm
from tests.support.fakes import CENTRES, blob_scene
from tests.support.windowless import marked

MUG, BOOK, PLANT = CENTRES


def split_the_view(s: Any) -> None:
    """The line is dragged without the camera; nothing is drawn for it, and nothing at rest."""
    rgb = s.shot("rgb")
    s.key("V")
    assert s.state.session.split.mode == "wipe"
    both, area, before = s.shot("both"), scene_area(), s.state.view
    np.testing.assert_allclose(s.at(both, MUG), s.at(rgb, MUG), atol=2)
    assert np.abs(s.at(both, PLANT) - s.at(rgb, PLANT)).max() > 40  # depth

    middle, y = area.left + area.width / 2, area.top + 0.8 * area.height
    drawn = s.drawn
    s.drag((middle, y), (area.left + 0.9 * area.width, y))
    assert abs(s.state.session.split.at - 0.9) < 0.02
    assert s.state.view is before
    assert s.drawn == drawn
    np.testing.assert_allclose(s.at(s.shot("wiped"), PLANT), s.at(rgb, PLANT), atol=2)

    s.drag((middle, y), (middle + 40, y))  # beside the line the camera turns as ever
    assert s.state.view is not before
    s.menu("View", "Three levels side by side")
    levels = s.shot("levels")
    assert s.drawn > drawn
    thirds = [levels[250:400, int(area.left + (i + 0.5) * area.width / 3)] for i in range(3)]
    assert np.abs(thirds[0] - thirds[2]).max() > 30
    s.draws_nothing()


def draw_over_the_scene(s: Any) -> None:
    """The end of an axis turns the view, a click on a camera stands there, two clicks measure."""
    s.menu("View", "Show or hide the axes")
    s.menu("View", "Show or hide the training cameras")
    area, before = scene_area(), s.state.view
    corner = s.ctx.item_info("//axes/sides").rect_full
    assert corner.max.x <= area.left + area.width + 1
    forward = from_side(before, "top").rotation[2]
    end = -before.rotation[:2] @ forward * overlays.REACH_OF_ENDS * (corner.max.x - corner.min.x)
    s.click_at(((corner.min.x + corner.max.x) / 2 + end[0], (corner.min.y + corner.max.y) / 2 + end[1]))
    np.testing.assert_allclose(s.state.view.rotation[2], forward, atol=1e-6)

    turn_the_wheel(s, 8)  # until all cameras are in the picture
    camera = s.state.scene.cameras[2]
    seen = s.shot("cameras")
    s.menu("View", "Show or hide the training cameras")
    assert np.abs(seen - s.shot("none"))[:, int(area.left) :].max() > 60
    s.menu("View", "Show or hide the training cameras")
    s.click_at(s.on_screen(camera.position))
    assert s.state.camera_index == 2
    got = s.state.view.camera(160, 120).world_to_camera
    np.testing.assert_allclose(got, camera.world_to_camera, atol=1e-9)

    s.key("M", frames=2)
    turned = s.state.view
    for thing in (MUG, BOOK):
        s.click_at(s.on_screen(thing))
    assert s.state.view is turned
    assert abs(s.state.session.ruler.length - np.linalg.norm(MUG - BOOK)) < 0.2
    s.ctx.mouse_double_click(0)  # two points in quick succession; elsewhere it would move the view
    s.settle()
    assert s.state.view is turned
    assert s.state.session.ruler.length is not None
    assert s.state.session.ruler.length < 0.05
    s.draws_nothing()
    s.key("escape", frames=2)
    assert not s.state.session.ruler.measures


def turn_the_wheel(s: Any, times: int) -> None:
    """Away from the scene, over its middle."""
    area = scene_area()
    for _ in range(times):
        s.ctx.mouse_teleport_to_pos((area.left + area.width / 2, area.top + area.height / 2))
        s.ctx.mouse_wheel_y(-1)
        s.ctx.yield_(2)
    s.settle()


def look_without_perspective(s: Any) -> None:
    """A key takes perspective away until it is pressed again; axes, wheel and the click on a camera work
    as ever, and the picture says what it is."""
    deep, view = s.shot("deep"), s.state.view
    s.key("O")
    assert s.state.view.orthographic
    flat, area = s.shot("flat"), scene_area()
    for thing in CENTRES:
        assert s.at(flat, thing).argmax() == s.at(deep, thing).argmax()
    corner = (slice(int(area.top + area.height) - 40, None), slice(int(area.left), int(area.left) + 200))
    assert (flat[corner].min(-1) > 200).sum() > 100  # words
    assert (deep[corner].min(-1) > 200).sum() == 0

    s.key("keypad1")
    before = s.on_screen(PLANT)[0] - s.on_screen(MUG)[0]
    turn_the_wheel(s, 1)
    assert abs((s.on_screen(PLANT)[0] - s.on_screen(MUG)[0]) / before - 0.88) < 1e-3

    s.menu("View", "Show or hide the training cameras")
    s.key("home")
    assert s.state.view.orthographic
    s.open_panel("Camera", frames=4)
    s.click("//Camera/###orthographic")
    poses = [one.camera(160, 120).world_to_camera for one in (s.state.view, view)]
    np.testing.assert_allclose(*poses, atol=1e-9)
    s.key("keypad5", frames=2)
    assert s.state.view.orthographic
    viewpoint.zoom_by(s.viewer, 4.0)  # until all cameras are in the picture
    s.settle()
    s.click_at(s.on_screen(s.state.scene.cameras[2].position))
    assert (s.state.camera_index, s.state.view.orthographic) == (2, False)


def name_what_is_close(s: Any) -> None:
    """Things in one line of sight have their names one above the other."""
    settings.toggle_overlay(s.viewer, "things")
    for word in ("mug", "book", "plant"):
        s.search(word)
    viewpoint.look_from(s.viewer, "left")
    s.settle()
    written, write = [], overlays.text_on_shade

    def remembered(text: str, x: float, y: float, area: Area) -> None:
        size = imgui.calc_text_size(text)
        written.append((text, PlacedText(x, y, size.x, size.y)))
        write(text, x, y, area)

    overlays.text_on_shade = remembered
    s.ctx.yield_(2)
    overlays.text_on_shade = write
    frame = dict(written)
    assert set(frame) == {"mug", "book", "plant"}
    assert not any(a.covers(b) for a, b in combinations(frame.values(), 2))
    assert written[:3] == written[3:6]  # from frame to frame the same


# Selecting.


def around(s: Any, centre: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two corners around a blob, as it is seen now."""
    x, y = s.on_screen(centre)
    right, _ = s.on_screen(centre + 0.6 * s.state.view.rotation[0])
    half = right - x
    return (x - half, y - half), (x + half, y + half)


def looks_selected(colour: np.ndarray) -> bool:
    """Whether a colour of the picture, 0 to 255, has the tint."""
    return bool(np.abs(colour - 255 * TINT).max() < 0.55 * 255 and colour[2] > colour[1] + 60)


def select_with_the_mouse(s: Any) -> None:
    """A rectangle, keys and buttons; what they did is undone."""
    s.key("period")  # the camera in front: no blob hides another
    plain = s.shot("plain")
    s.menu("Window", "Select")
    s.click("//**/Rectangle##tool")
    s.drag(*around(s, PLANT))
    seen = s.state.marks.selected
    assert 10 < seen.sum() < 110  # the front of it
    s.click("//**/Only what is visible")
    before = s.state.view
    s.drag(*around(s, PLANT))
    assert s.state.view is before  # the drag turned nothing
    assert marked(s.viewer) == ("plant", "", "")
    chosen = s.shot("chosen")
    assert looks_selected(s.at(chosen, PLANT))
    np.testing.assert_allclose(s.at(chosen, BOOK), s.at(plain, BOOK), atol=6)

    s.ctx.key_down(imgui.Key.mod_shift)
    s.drag(*around(s, BOOK))
    s.ctx.key_up(imgui.Key.mod_shift)
    assert marked(s.viewer)[0] == "book plant"

    s.key("H")
    assert marked(s.viewer) == ("", "book plant", "")
    s.key("Ctrl+Z")
    assert marked(s.viewer) == ("book plant", "", "")
    s.key("escape", frames=3)
    assert s.state.tools.tool is None
    s.drag((600, 300), (656, 279))
    assert not np.array_equal(before.rotation, s.state.view.rotation)  # the drag turns again


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


def name_what_is_clicked(s: Any) -> None:
    """A thing is clicked, named in the panel, and found by its name; what is like it is selected."""
    s.menu("Window", "Select")
    s.click("//**/Thing##tool")
    s.click_at(s.on_screen(PLANT))
    assert marked(s.viewer)[0] == "plant"
    s.ctx.item_click("//Select/##name")
    s.enter("grandma's mug")
    assert s.state.session.chosen == "grandma's mug"
    np.testing.assert_array_equal(result(s).members, s.state.marks.selected)
    s.click("//**/More like it")
    assert marked(s.viewer)[0] == "plant"


def drag_the_gizmo(s: Any) -> None:
    """What was found is moved by the gizmo's middle, and seen there; the camera stays. Numbers and the crop
    box do the rest, and all is undone."""
    viewer, before = s.viewer, s.state.scene.gaussians.means.copy()
    rgb = s.shot("rgb")
    s.search("mug")
    editing.select_query(viewer)
    settings.set_display(viewer, "rgb")
    s.open_panel("Transform", frames=1)
    s.key("G")
    view, chosen = s.state.view, s.state.marks.selected
    x, y = s.on_screen(editing.pivot(viewer))
    s.ctx.mouse_teleport_to_pos((x, y))
    for covered in (True, False):  # by a window over the scene, whose mouse it leaves alone
        viewer.state.show_help = covered
        s.ctx.yield_(3)
        assert select.holds_mouse(viewer) != covered
    with s.dragging((x, y), (x + 60, y - 120)):
        assert s.state.moving is not None
        s.capture(s.folder / "dragging.png")
    s.settle()
    assert s.state.view is view
    moved = s.state.scene.gaussians.means - before
    assert (moved[~chosen] == 0).all()
    assert np.ptp(moved[chosen], axis=0).max() < 1e-5
    went = s.on_screen(editing.pivot(viewer))
    np.testing.assert_allclose(went, (x + 60, y - 120), atol=3)
    editing.select_none(viewer)
    for _ in range(4):  # off again
        s.key("G", frames=1)
    shot = s.shot("moved")
    assert s.at(shot, MUG + moved[chosen][0]).argmax() == s.at(rgb, MUG).argmax()
    assert np.abs(s.at(shot, MUG) - s.at(rgb, MUG)).max() > 40

    viewer.state.edit_form = EditForm(rotate=(0.0, 0.0, 90.0))
    s.ctx.item_click("//Transform/Apply")
    s.click("//Transform/Fit")
    form = s.state.edit_form
    viewer.state.edit_form = replace(form, high=(*form.high[:2], (form.low[2] + form.high[2]) / 2))
    s.click("//Transform/Crop")
    assert 0 < s.state.marks.deleted.sum() < len(chosen)
    for _ in range(5):
        s.key("Ctrl+Z")
    np.testing.assert_array_equal(s.state.scene.gaussians.means, before)
    assert not s.state.is_unsaved


def drag_the_crop_box(s: Any) -> None:
    """A corner of the box is dragged, and what lies outside is cropped."""
    viewer = s.viewer
    s.open_panel("Transform", frames=1)
    editing.fill_box(viewer)
    s.ctx.yield_(2)
    s.ctx.item_click("//Transform/Box##gizmo")
    form, means = s.state.edit_form, s.state.scene.gaussians.means
    middle = np.array(s.on_screen(np.mean([form.low, form.high], 0)))
    for corner in product(*zip(form.low, form.high, strict=True)):
        start = np.array(s.on_screen(np.array(corner)))
        s.drag(tuple(start), tuple(start + 0.8 * (middle - start)))
        if s.state.edit_form != form:
            break
    low, high = s.state.edit_form.low, s.state.edit_form.high
    inside = ((means >= low) & (means <= high)).all(1)
    s.click("//Transform/Crop")
    np.testing.assert_array_equal(s.state.marks.shown, inside)
    assert 0 < inside.sum() < len(means)
    s.key("Ctrl+Z")
    s.ctx.item_click("//Transform/No gizmo##gizmo")
    assert s.state.marks.shown.all()


def compare_two_scenes(s: Any) -> None:
    """Right of the line another scene is drawn by the same camera and answers the same phrase; a saved
    picture has both; without the line it is gone."""
    viewer = s.viewer
    s.search("mug")
    alone, area = s.shot("alone"), scene_area()
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
    settings.set_display(viewer, "relevancy")
    assert (s.shot("asked") == alone)[100:450, 450 : middle - 8].all()
    s.key("P", frames=1)
    s.wait((s.folder / "blobs-001.png").exists)
    saved = np.asarray(Image.open(s.folder / "blobs-001.png")).astype(int)
    half = saved.shape[1] // 2
    shown = s.shot("shown")[int(area.top) :, int(area.left) :]
    np.testing.assert_allclose(saved[120:400, 100 : half - 8], shown[120:400, 100 : half - 8], atol=3)
    np.testing.assert_allclose(saved[120:400, half + 8 :], shown[120:400, half + 8 : saved.shape[1]], atol=3)
    settings.set_split(viewer, "off")
    assert (s.shot("alone again") == alone)[100:450, 450:].all()
    assert viewer.beside is None


def pin_a_note(s: Any) -> None:
    """What is typed after the click is its text; it is kept in the project, and undone."""
    s.key("N", frames=2)
    s.click_at(s.on_screen(BOOK))
    s.wait(lambda: imgui.get_io().want_text_input)
    s.ctx.key_chars("lent by Ada")
    s.key("enter", frames=2)
    (note,) = s.state.session.notes
    assert (note.text, s.state.pins_notes) == ("lent by Ada", False)
    assert np.linalg.norm(note.at - BOOK) < 1.0
    s.key("Ctrl+Shift+S", frames=1)
    s.until((s.folder / "blobs-001.langsplat").exists)
    for left in (1, 0):
        s.key("Ctrl+Z")
        assert len(s.state.session.notes) == left
    opening.open_file(s.viewer, s.folder / "blobs-001.langsplat")
    s.until(lambda: s.state.session.notes == (note,))
