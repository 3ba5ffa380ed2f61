"""Scenarios of `window_driver` about seeing: several pictures, what is drawn over them, measuring."""

from collections.abc import Callable
from typing import Any

import numpy as np

from imgui_bundle import imgui  # isort: skip
from langsplat_viewer.panels.area import scene_area
from tests.support.fakes import CENTRES

MUG, BOOK, PLANT = CENTRES


def begin(s: Any) -> None:
    s.wait(lambda: s.state.scene is not None)
    s.settle()


def split_the_view(s: Any) -> None:
    """The line is dragged without the camera; nothing is drawn for it, and nothing at rest."""
    begin(s)
    rgb = s.shot("rgb")
    s.ctx.key_press(imgui.Key.v)
    s.settle()
    assert s.state.seeing.split.mode == "wipe"
    both, area, before = s.shot("both"), scene_area(), s.state.view
    np.testing.assert_allclose(s.at(both, MUG), s.at(rgb, MUG), atol=2)
    assert np.abs(s.at(both, PLANT) - s.at(rgb, PLANT)).max() > 40  # depth

    middle, y = area.left + area.width / 2, area.top + 0.8 * area.height
    drawn = s.renderer.count
    s.drag((middle, y), (area.left + 0.9 * area.width, y))
    s.settle()
    assert abs(s.state.seeing.split.at - 0.9) < 0.02
    assert s.state.view is before
    assert s.renderer.count == drawn
    np.testing.assert_allclose(s.at(s.shot("wiped"), PLANT), s.at(rgb, PLANT), atol=2)

    s.drag((middle, y), (middle + 40, y))  # beside the line the camera turns as ever
    s.settle()
    assert s.state.view is not before
    s.menu("View", "Three levels side by side")
    s.settle()
    levels = s.shot("levels")
    assert s.renderer.count > drawn
    thirds = [levels[250:400, int(area.left + (i + 0.5) * area.width / 3)] for i in range(3)]
    assert np.abs(thirds[0] - thirds[2]).max() > 30
    drawn = s.renderer.count
    s.ctx.yield_(20)
    assert s.renderer.count == drawn


Scenario = tuple[Callable[[Any], None], str, dict[str, Any]]
SCENARIOS: dict[str, Scenario] = {
    "split_the_view": (split_the_view, "blobs.ply", {}),
}
