"""Scenarios of `window_driver` about files: those that change while they are shown."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from imgui_bundle import imgui  # isort: skip
from langsplat_core.formats import save_scene
from tests.support.fakes import CENTRES, blob_scene


def reload_what_changed(s: Any) -> None:
    """A bar appears by itself, its button reads the file again, camera and queries stay."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
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


def change_a_key(s: Any) -> None:
    """The key that is pressed is the command's from then on, and does nothing else while it is waited for."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    key, ctrl = imgui.Key, imgui.Key.mod_ctrl
    s.menu("Help", "Change the keys")
    s.ctx.yield_(3)
    s.ctx.item_click("//Keys/##words")
    s.ctx.key_chars("show")
    s.ctx.yield_(3)
    s.shot("some keys")
    s.ctx.item_click("//**/show depth/2 ##key")
    s.ctx.yield_(2)
    assert s.state.keying.waiting == "show depth"
    s.shot("waiting")
    s.ctx.key_press(ctrl | key.z)  # of "undo"
    s.ctx.yield_(3)
    assert s.state.keying.conflict.owner == "undo"
    s.shot("conflict")
    s.ctx.item_click("//Keys/Leave it")
    s.ctx.item_click("//**/show depth/2 ##key")
    s.ctx.yield_(2)
    s.ctx.key_press(key.space)
    s.ctx.yield_(3)
    assert s.state.preferences.keys == {"show depth": ("Space",)}
    s.ctx.item_click("//**/show alpha/3 ##key")
    s.ctx.yield_(2)
    s.ctx.key_press(key.escape)
    s.ctx.yield_(3)
    assert s.state.show_help
    assert s.state.keying.waiting == ""
    s.ctx.item_click("//**/show alpha/3 ##key")
    s.ctx.yield_(2)
    s.ctx.key_chars("%")
    s.ctx.yield_(3)
    assert s.state.preferences.keys["show alpha"] == ("%",)
    s.shot("changed keys")
    s.ctx.key_press(key.escape)
    s.ctx.yield_(3)
    assert not s.state.show_help
    s.ctx.key_press(digit_key(2))
    s.ctx.yield_(3)
    assert s.state.picture.display == "rgb"
    s.ctx.key_press(key.space)
    s.ctx.yield_(3)
    assert s.state.picture.display == "depth"
    s.ctx.key_chars("%")
    s.ctx.yield_(3)
    assert s.state.picture.display == "alpha"


def digit_key(digit: int) -> imgui.Key:
    return imgui.Key[f"_{digit}"]


Scenario = tuple[Callable[[Any], None], str, dict[str, Any]]
SCENARIOS: dict[str, Scenario] = {
    "reload_what_changed": (reload_what_changed, "blobs.ply", {}),
    "change_a_key": (change_a_key, "blobs.ply", {}),
}
