"""Selecting in the real window; played by `window_driver`."""

from typing import TYPE_CHECKING, Any

import numpy as np

from imgui_bundle import hello_imgui, imgui  # isort: skip
from imgui_bundle.glfw_utils import glfw_window_hello_imgui  # isort: skip
import glfw  # isort: skip
from langsplat_core.io.scenes import load_scene
from langsplat_viewer.panels.style import scene_area
from langsplat_viewer.rendering.request import TINT
from tests.support.fakes import CENTRES
from tests.support.selected import marked

if TYPE_CHECKING:
    from tests.viewer.window_driver import Session

MUG, BOOK, PLANT = CENTRES


def on_screen(s: "Session", point: np.ndarray) -> tuple[float, float]:
    """Where a world point is, in window units."""
    (pixel,), _ = s.state.view.camera(*s.state.size).project(np.asarray(point, float)[None])
    area = scene_area()
    return float(pixel[0] + area.left), float(pixel[1] + area.top)


def around(s: "Session", centre: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Two corners around a blob, as it is seen now."""
    x, y = on_screen(s, centre)
    right, _ = on_screen(s, centre + 0.6 * s.state.view.rotation[0])
    half = right - x
    return (x - half, y - half), (x + half, y + half)


def looks_selected(colour: np.ndarray) -> bool:
    """Whether a colour of the picture, 0 to 255, has the tint."""
    return bool(np.abs(colour - 255 * TINT).max() < 0.55 * 255 and colour[2] > colour[1] + 60)


def click(s: "Session", item: str) -> None:
    s.ctx.item_click(item)
    s.settle()


def select_with_the_mouse(s: "Session") -> None:
    """A rectangle, keys and buttons; everything is undone; what is left is saved."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    s.ctx.key_press(imgui.Key.period)  # the camera in front: no blob hides another
    s.settle()
    plain = s.shot("plain")
    s.menu("Window", "Select")
    s.settle()
    click(s, "//**/Rectangle##tool")
    s.drag(*around(s, PLANT))
    s.settle()
    seen = s.state.selection.marks.selected
    assert 10 < seen.sum() < 110  # the front of it
    click(s, "//**/Only what is visible")
    before = s.state.view
    s.drag(*around(s, PLANT))
    s.settle()
    assert s.state.view is before  # the drag turned nothing
    assert marked(s.window.viewer) == ("plant", "", "")
    chosen = s.shot("chosen")
    assert looks_selected(s.at(chosen, PLANT))
    np.testing.assert_allclose(s.at(chosen, BOOK), s.at(plain, BOOK), atol=6)

    s.ctx.key_down(imgui.Key.mod_shift)
    s.drag(*around(s, BOOK))
    s.ctx.yield_(2)
    s.ctx.key_up(imgui.Key.mod_shift)
    s.settle()
    assert marked(s.window.viewer)[0] == "book plant"

    hide_and_undo(s, plain)
    save_the_rest(s)
    s.ctx.key_press(imgui.Key.escape)
    s.ctx.yield_(3)
    assert s.state.selection.tool is None
    s.drag((600, 300), (656, 279))
    s.settle()
    assert not np.array_equal(before.rotation, s.state.view.rotation)  # the drag turns again


def hide_and_undo(s: "Session", plain: np.ndarray) -> None:
    s.ctx.key_press(imgui.Key.h)
    s.settle()
    assert marked(s.window.viewer) == ("", "book plant", "")
    hidden = s.shot("hidden")
    assert s.at(hidden, PLANT).max() < 30
    assert s.at(plain, PLANT).max() > 90
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.z)
    s.settle()
    assert marked(s.window.viewer) == ("book plant", "", "")


def save_the_rest(s: "Session") -> None:
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.i)
    s.settle()
    assert marked(s.window.viewer)[0] == "mug"
    s.menu("Select", "Save the selection")
    s.settle()
    written = load_scene(s.folder / "blobs-selection-001.ply")
    assert len(written.gaussians) == len(written.language) == s.state.selection.marks.selected.sum()


def outline_and_rest(s: "Session") -> None:
    """An outline is drawn while the button is held, Esc gives it up, and nothing is drawn again at rest."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    s.menu("Select", "Select: lasso")
    s.settle()
    s.ctx.mouse_teleport_to_pos((500, 200))
    s.ctx.mouse_down(0)
    for place in ((700, 200), (700, 400), (520, 390)):
        s.ctx.mouse_teleport_to_pos(place)
        s.ctx.yield_(2)
    assert len(s.state.selection.stroke.path) == 4
    line = s.shot("lasso")[196:205, 600]
    assert line.min(1).max() > 100  # a light line on black
    s.ctx.key_press(imgui.Key.escape)
    s.ctx.mouse_up(0)
    s.settle()
    assert (s.state.selection.stroke, s.state.selection.tool) == (None, "lasso")
    assert marked(s.window.viewer)[0] == ""
    drawn = s.renderer.count
    s.ctx.yield_(20)
    assert s.renderer.count == drawn


def ask_before_leaving(s: "Session") -> None:
    """What was deleted and not saved is asked about before another scene opens or the window closes."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    s.search("mug")
    s.menu("Select", "Select what the search found")
    s.ctx.key_press(imgui.Key.delete)
    s.settle()
    assert marked(s.window.viewer) == ("", "", "mug")
    s.window.drop([str(s.folder / "plain.ply")])
    s.ctx.yield_(4)
    s.shot("question")
    click(s, "//**/Cancel")
    assert s.state.path.name == "blobs.ply"

    s.menu("File", "Quit")
    assert not hello_imgui.get_runner_params().app_shall_exit
    click(s, "//**/Cancel")
    assert not s.state.selection.may_close
    glfw.set_window_should_close(glfw_window_hello_imgui(), True)  # its cross was clicked
    s.wait(lambda: s.state.selection.leaving is not None)
    click(s, "//**/Cancel")
    assert marked(s.window.viewer) == ("", "", "mug")

    s.window.drop([str(s.folder / "plain.ply")])
    s.ctx.yield_(4)
    click(s, "//**/Not saved/Save")
    s.wait(lambda: s.state.path.name == "plain.ply")
    s.settle()
    assert len(load_scene(s.folder / "blobs-edited-001.ply").gaussians) < 360
    assert len(load_scene(s.folder / "blobs.ply").gaussians) == 360  # as it was


SCENARIOS: dict[str, tuple[Any, str, dict[str, Any]]] = {
    "select_with_the_mouse": (select_with_the_mouse, "blobs.ply", {}),
    "outline_and_rest": (outline_and_rest, "blobs.ply", {}),
    "ask_before_leaving": (ask_before_leaving, "blobs.ply", {}),
}
