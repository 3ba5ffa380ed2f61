"""Going along the camera path: played, or by hand."""

import math

from langsplat_viewer.camera.controls import OrbitCamera, orbit
from langsplat_viewer.camera.flight import pose_at, view_of
from langsplat_viewer.recording import flight_of
from langsplat_viewer.viewer import Viewer


def path_seconds(viewer: Viewer) -> float:
    """How long the path takes; 0 without one."""
    record = viewer.state.record
    if record.turns:
        return record.turn_seconds
    return record.keyframes[-1].seconds if record.keyframes else 0.0


def toggle_playing(viewer: Viewer) -> None:
    """Play the path from where it is, or stop there."""
    record = viewer.state.record
    if record.began is not None:
        record.began = None
    elif viewer.state.view is None:
        viewer.state.say("open a scene first, then play a path in it", is_error=True)
    elif path_seconds(viewer) <= 0:
        viewer.state.say("a path needs two keyframes: add one at the current view", is_error=True)
    else:
        start = 0.0 if record.at >= path_seconds(viewer) else record.at
        scrub(viewer, start)
        record.began = viewer.clock - start


def scrub(viewer: Viewer, seconds: float) -> None:
    """Show the path at a time, stopped."""
    state, record = viewer.state, viewer.state.record
    if state.view is None or not (record.turns or record.keyframes):
        return
    if record.turns and record.turn_from is None:
        record.turn_from = state.view
    record.began, state.glide = None, None
    _show(viewer, min(max(seconds, 0.0), path_seconds(viewer)))


def advance(viewer: Viewer) -> None:
    """Move a played path on to the viewer's clock; at its end it stops, or begins again."""
    record = viewer.state.record
    if record.began is None:
        return
    seconds, at = path_seconds(viewer), viewer.clock - record.began
    if viewer.state.view is None or seconds <= 0:
        record.began = None
        return
    if at >= seconds and record.loops:
        at %= seconds
        record.began = viewer.clock - at
    elif at >= seconds:
        record.began = None
    _show(viewer, min(at, seconds))


def leave_path(viewer: Viewer) -> None:
    """The view goes elsewhere: nothing is played any more, and a turn begins anew from there."""
    viewer.state.record.began = None
    if viewer.state.record.turn_from is not None:
        viewer.state.record.turn_from, viewer.state.record.at = None, 0.0


def _show(viewer: Viewer, seconds: float) -> None:
    viewer.state.record.at = seconds
    viewer.state.view = _view_at(viewer, seconds)


def _view_at(viewer: Viewer, seconds: float) -> OrbitCamera | None:
    state, record = viewer.state, viewer.state.record
    if record.turns and record.turn_from is not None:
        return orbit(record.turn_from, 2 * math.pi * seconds / record.turn_seconds, 0)
    if state.extent is None or not record.keyframes:
        return state.view
    return view_of(pose_at(flight_of(record.keyframes), seconds), state.extent)
