"""Selecting with the mouse: a stroke begins, goes on and ends; (u, v) are fractions of the scene's area."""

from dataclasses import replace

import numpy as np

from langsplat_core.query.selection import at_point
from langsplat_core.scene import LEVELS
from langsplat_viewer.actions.selecting import find, reach, take, use_tool
from langsplat_viewer.drawing.seeing import UNCLIPPED
from langsplat_viewer.marks import strokes
from langsplat_viewer.marks.selecting import Mode, Stroke
from langsplat_viewer.marks.strokes import Drawn
from langsplat_viewer.parallel import eye_depth
from langsplat_viewer.viewer import Viewer

STEP = 0.002  # of the picture: places nearer to each other are one
LONGEST = 4000  # places of a stroke that are kept


def begin_stroke(viewer: Viewer, u: float, v: float) -> None:
    """The button goes down. A sphere and a box are drawn around the surface that lies there."""
    state = viewer.state
    tool, centre = state.selection.tool, None
    if tool is None or state.scene is None or state.view is None:
        return
    if tool not in strokes.ON_SCREEN:
        point = None if viewer.surface is None else viewer.surface.point_at(u, v)
        if point is None:
            state.say("nothing under the cursor to select")
            return
        centre = (float(point[0]), float(point[1]), float(point[2]))
    state.glide = None
    state.selection = replace(state.selection, stroke=Stroke(((u, v),), centre))


def extend_stroke(viewer: Viewer, u: float, v: float) -> None:
    """The mouse is there now."""
    selection = viewer.state.selection
    stroke = selection.stroke
    if stroke is None:
        return
    (last_u, last_v), moved = stroke.path[-1], stroke.path
    if max(abs(u - last_u), abs(v - last_v)) >= STEP and len(moved) < LONGEST:
        stroke = replace(stroke, path=(*moved, (u, v)))
        viewer.state.selection = replace(selection, stroke=stroke)


def end_stroke(viewer: Viewer, mode: Mode | None = None) -> None:
    """The button goes up: select what the stroke encloses; `mode` in place of the one that is set."""
    state, drawn = viewer.state, drawn_stroke(viewer)
    if drawn is None or state.scene is None:
        return
    cancel_stroke(viewer)
    if drawn.tool == "thing":
        _select_under(viewer, drawn.stroke, mode)
        return
    wanted = state.selection.only_visible and drawn.tool in strokes.ON_SCREEN and viewer.surface is not None
    depths = viewer.surface.depths() if wanted and viewer.surface is not None else None
    means, clip = state.scene.gaussians.means, state.seeing.clip.beyond(eye_depth(drawn.camera))
    found = strokes.caught(drawn, means, depths)
    if clip != UNCLIPPED and drawn.tool in strokes.ON_SCREEN:  # what is not drawn lies under no outline
        found &= clip.keeps(means @ drawn.camera.rotation[2] + drawn.camera.world_to_camera[2, 3])
    take(viewer, found, mode)


def drawn_stroke(viewer: Viewer) -> Drawn | None:
    """The stroke under way, in the picture as it is; None without one."""
    state = viewer.state
    tool, stroke = state.selection.tool, state.selection.stroke
    if tool is None or stroke is None or state.view is None:
        return None
    return Drawn(tool, stroke, state.view.camera(*state.size), state.selection.brush, reach(viewer))


def cancel_stroke(viewer: Viewer) -> None:
    """Select nothing by it."""
    viewer.state.selection = replace(viewer.state.selection, stroke=None)


def leave_tool(viewer: Viewer) -> None:
    """Give up the stroke under way; without one, the tool."""
    if viewer.state.selection.stroke is not None:
        cancel_stroke(viewer)
    else:
        use_tool(viewer, None)


def _select_under(viewer: Viewer, stroke: Stroke, mode: Mode | None) -> None:
    """The thing at the stroke's centre, or the part of it if that is the level of the queries."""
    state = viewer.state
    if state.scene is None or stroke.centre is None:
        return
    if state.scene.language is None:
        state.say("without a language field no things are known: use a brush, sphere or box", is_error=True)
        return
    level = LEVELS.index("whole" if state.level == "auto" else state.level)
    centre = np.array(stroke.centre)
    find(
        viewer,
        "finding the thing for",
        lambda engine: at_point(engine.surface, engine.regions, level, centre),
        mode,
    )
