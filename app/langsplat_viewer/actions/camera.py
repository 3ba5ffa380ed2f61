"""Time, and the camera that moves in it: at once, or gliding from view to view."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera
from langsplat_viewer.actions.playback import advance, leave_path
from langsplat_viewer.camera.controls import (
    OrbitCamera,
    Side,
    between,
    default_view,
    focus,
    frame_all,
    from_camera,
    from_side,
    holding_distance,
    in_parallel,
    in_perspective,
    spanning,
    zoom,
)
from langsplat_viewer.state import GLIDE_SECONDS, Glide, Query
from langsplat_viewer.viewer import Viewer

NEAREST = 0.004  # of the scene's radius: the closest that the eye comes to its centre of turning


def tick(viewer: Viewer, now: float) -> None:
    """Start of a frame at `now` seconds: take what the worker finished and move a gliding camera on."""
    viewer.clock = now
    viewer.worker.poll()
    viewer.recorder.poll()
    glide = viewer.state.glide
    if glide is not None:
        t = (now - glide.began) / GLIDE_SECONDS
        viewer.state.view = between(glide.start, glide.end, t)
        if t >= 1:
            viewer.state.glide = None
    advance(viewer)


def move(viewer: Viewer, step: Callable[[OrbitCamera], OrbitCamera]) -> None:
    """Apply one of the functions of `controls` at once; it ends a glide."""
    if viewer.state.view is not None:
        leave_path(viewer)
        viewer.state.view, viewer.state.glide = step(viewer.state.view), None


def open_at(viewer: Viewer, camera: Camera) -> None:
    """Take a camera's view at once; it is the opening view from now on."""
    extent, scene = viewer.state.extent, viewer.state.scene
    if extent is not None and scene is not None:
        same = (
            i
            for i, own in enumerate(scene.cameras)
            if np.array_equal(own.world_to_camera, camera.world_to_camera)
        )
        viewer.state.camera_index = next(same, None)
        viewer.state.opening_camera = camera
        move(viewer, lambda view: from_camera(camera, extent))


def glide_to(viewer: Viewer, end: OrbitCamera) -> None:
    """Move smoothly to a view."""
    if viewer.state.view is not None:
        leave_path(viewer)
        viewer.state.glide = Glide(viewer.state.view, end, viewer.clock)


def zoom_by(viewer: Viewer, factor: float) -> None:
    """Multiply the distance to the centre of turning, within what the scene's size makes sensible."""
    extent = viewer.state.extent
    if extent is not None:
        nearest, farthest = NEAREST * extent.radius, extent.farthest
        move(viewer, lambda view: zoom(view, factor, nearest, farthest))


def set_fly_speed(viewer: Viewer, speed: float) -> None:
    """How fast the keys fly, scene radii per second."""
    viewer.state.fly_speed = speed


def opening_view(viewer: Viewer) -> OrbitCamera | None:
    """Where a scene is first seen from: the camera that was asked for, else the first training camera, else a
    view of everything in the window as it is now. None without a scene."""
    state = viewer.state
    if state.scene is None or state.extent is None:
        return None
    if state.opening_camera is not None:
        return from_camera(state.opening_camera, state.extent)
    return default_view(state.scene, state.extent, state.size)


def reset_view(viewer: Viewer) -> None:
    """Return to the opening view, in the projection of now."""
    view, extent = opening_view(viewer), viewer.state.extent
    if view is None or extent is None:
        return
    if viewer.state.view is not None and viewer.state.view.back:
        view = in_parallel(view, extent)
        if _opens_framed(viewer):
            view = frame_all(view, extent, viewer.state.size)
    glide_to(viewer, view)


def _opens_framed(viewer: Viewer) -> bool:
    """Whether the opening view is one of everything."""
    scene = viewer.state.scene
    return viewer.state.opening_camera is None and scene is not None and not scene.cameras


def frame_scene(viewer: Viewer) -> None:
    """Show the whole scene, from the side that it is seen from now."""
    state = viewer.state
    if state.view is not None and state.extent is not None:
        glide_to(viewer, frame_all(state.view, state.extent, state.size))


def look_from(viewer: Viewer, side: Side) -> None:
    """Look at what the view turns around along one of the world's axes, from as far as now."""
    if viewer.state.view is not None:
        glide_to(viewer, from_side(viewer.state.view, side))


def set_orthographic(viewer: Viewer, orthographic: bool) -> None:
    """Look without perspective, or with it again; a glide under way goes on."""
    state = viewer.state
    view, extent, glide = state.view, state.extent, state.glide
    if view is None or extent is None or bool(view.back) == orthographic:
        return

    def turned(view: OrbitCamera) -> OrbitCamera:
        return in_parallel(view, extent) if orthographic else in_perspective(view)

    move(viewer, turned)
    state.glide = None if glide is None else replace(glide, end=turned(glide.end))


def toggle_orthographic(viewer: Viewer) -> None:
    """Look without perspective, or with it again."""
    set_orthographic(viewer, viewer.state.view is not None and not viewer.state.view.back)


def open_orthographic(viewer: Viewer, span: float) -> None:
    """Look without perspective, `span` world units across the shorter side of the uncropped picture."""
    extent = viewer.state.extent
    if extent is not None:
        move(viewer, lambda view: spanning(view, span, extent))


def set_walking(viewer: Viewer, walks: bool) -> None:
    """Whether the keys that fly ahead keep the height of the eye."""
    viewer.state.walks = walks


def toggle_walking(viewer: Viewer) -> None:
    """Walk, or fly again."""
    set_walking(viewer, not viewer.state.walks)
    viewer.state.say("W A S D walk at one height" if viewer.state.walks else "W A S D fly")


def go_to_camera(viewer: Viewer, index: int) -> None:
    """Stand where a training photograph was taken; indices beyond the ends wrap round."""
    scene, extent = viewer.state.scene, viewer.state.extent
    if scene is None or extent is None:
        return
    if not scene.cameras:
        viewer.state.say("this scene has no training cameras (no .cameras.json beside it)", is_error=True)
        return
    viewer.state.camera_index = index % len(scene.cameras)
    glide_to(viewer, from_camera(scene.cameras[viewer.state.camera_index], extent))


def step_camera(viewer: Viewer, by: int) -> None:
    """The next (1) or previous (-1) training camera."""
    go_to_camera(viewer, (viewer.state.camera_index or 0) + by)


def focus_result(viewer: Viewer, query: Query | None = None) -> None:
    """Bring a query's place to the centre, as near as the thing is small; without `query` the latest
    one shown that was found; without any the whole scene."""
    state = viewer.state
    if state.extent is None or state.view is None:
        return
    if query is None:
        found = [q for q in state.in_order_of_showing() if q.result and q.result.found]
        query = found[-1] if found else None
    place = None if query is None or query.result is None else query.result.place
    if query is None or query.result is None or place is None:
        frame_scene(viewer)
        return
    glide_to(viewer, focus(state.view, place, _distance_for(viewer, place, query.result.box)))


def _distance_for(viewer: Viewer, place: Array, box: Array | None) -> float:
    """From where a thing at `place` (3,) in `box` (2, 3) is seen, world units: no farther back than the
    eye or the opening view are now, which in a room would be behind its wall."""
    view, extent, home = viewer.state.view, viewer.state.extent, opening_view(viewer)
    assert view is not None
    assert extent is not None
    assert home is not None
    if box is None:
        box = np.stack([place, place + 0.1 * extent.radius])
    most = max(float(np.linalg.norm(place - view.eye)), home.distance)
    return min(max(holding_distance(view, box), NEAREST * extent.radius), most)


def focus_pixel(viewer: Viewer, u: float, v: float) -> None:
    """Turn around the surface under the cursor from now on; (u, v) are fractions of the scene's area."""
    if viewer.surface is None or viewer.state.view is None:
        return
    point = viewer.surface.point_at(u, v)
    if point is None:
        viewer.state.say("nothing under the cursor to turn around")
        return
    view = viewer.state.view
    # The eye stays, but in parallel projection the size of things does.
    depth = None if view.back else float((point - view.eye) @ view.rotation[2])
    glide_to(viewer, focus(view, point, depth))
