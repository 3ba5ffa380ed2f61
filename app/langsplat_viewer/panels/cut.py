"""Where an answer ends: a histogram of its relevancies, and a slider over it."""

from functools import lru_cache

import numpy as np
from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.arrays import Array
from langsplat_core.query.answers import QueryResult
from langsplat_viewer import actions
from langsplat_viewer.panels.style import muted
from langsplat_viewer.state import Query
from langsplat_viewer.viewer import Viewer

BINS = 64
HEIGHT_EM = 3.0


def draw(viewer: Viewer, query: Query, result: QueryResult) -> None:
    """Histogram, slider, and a button that lets the answer end by itself again."""
    low, high, counts = histogram(query.automatic or result)
    height = hello_imgui.em_size(HEIGHT_EM)
    imgui.plot_histogram("##relevancies", counts, graph_size=ImVec2(-1, height))
    corner, size = imgui.get_item_rect_min(), imgui.get_item_rect_size()
    if imgui.is_item_hovered():
        imgui.set_tooltip("Gaussians by relevancy, on a logarithmic scale; the line is where the answer ends")
    x = corner.x + size.x * (min(max(result.cut, low), high) - low) / (high - low)
    colour = imgui.get_color_u32(imgui.Col_.slider_grab_active)
    imgui.get_window_draw_list().add_line(ImVec2(x, corner.y), ImVec2(x, corner.y + size.y), colour, 2.0)
    own = result.own_cut is not None
    button = imgui.calc_text_size("Auto").x + 2 * imgui.get_style().frame_padding.x
    imgui.set_next_item_width(-(button + imgui.get_style().item_spacing.x) if own else -1)
    changed, value = imgui.slider_float("##cut", result.cut, low, high, "ends at %.3f")
    if changed:
        actions.set_cut(viewer, query, value, is_new=not own)
    if own:
        imgui.same_line()
        if imgui.button("Auto"):
            actions.set_cut(viewer, query, None)
    imgui.text_colored(muted(), f"{int(result.members.sum()):,} Gaussians")


@lru_cache(maxsize=8)
def histogram(result: QueryResult) -> tuple[float, float, Array]:
    """Lowest and highest relevancy of an answer, and (BINS,) float32 log(1 + n) of how many Gaussians have
    which."""
    values = result.even[np.isfinite(result.even)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    high = max(high, low + 1e-3)
    counts, _ = np.histogram(values, BINS, (low, high))
    return low, high, np.log1p(counts).astype(np.float32)
