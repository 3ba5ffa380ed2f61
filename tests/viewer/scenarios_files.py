"""Scenarios of `window_driver` about files: those that change while they are shown."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

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


Scenario = tuple[Callable[[Any], None], str, dict[str, Any]]
SCENARIOS: dict[str, Scenario] = {
    "reload_what_changed": (reload_what_changed, "blobs.ply", {}),
}
