"""Scenarios of `window_driver` about where things lie: large letters, long words."""

from collections.abc import Callable
from typing import Any

from imgui_bundle import imgui  # isort: skip
from langsplat_viewer.actions import settings
from langsplat_viewer.panels.layout import PANELS
from langsplat_viewer.panels.style import scene_area

LONG = "mugg or boook or plent or mugg or boook or plent or mugg or boook or plent or mugg"


def large_letters(s: Any) -> None:
    """At twice the size, in a small window: the column grows, and no widget of any panel is cut off."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    for phrase in ("mug or plant", LONG):
        s.search(phrase)
    assert s.state.queries[-1].meant  # a long one, and so is the button for it
    narrow = scene_area().left
    settings.set_ui_scale(s.window.viewer, 2.0)
    s.settle()
    assert 1.3 * narrow < scene_area().left <= 0.41 * 1280
    for panel in PANELS:
        settings.open_panel(s.window.viewer, panel.title)
        s.settle()
        assert seen_items(s, panel.title), panel.title
        assert cut_off(s, panel.title) == [], panel.title
    settings.show_help(s.window.viewer, True)
    s.settle()
    keys = s.ctx.window_info("//Keys").window
    assert 0 <= keys.pos.x <= keys.pos.x + keys.size.x <= 1280
    assert 0 <= keys.pos.y <= keys.pos.y + keys.size.y <= 720
    s.shot("large letters")
    settings.escape(s.window.viewer)
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


SCENARIOS: dict[str, tuple[Callable[[Any], None], str, dict[str, Any]]] = {
    "large_letters": (large_letters, "blobs.ply", {"size": (1280, 720)}),
}
