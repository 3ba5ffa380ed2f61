"""Time, and the camera that moves in it: at once, or gliding from view to view."""

from collections.abc import Callable

import numpy as np

from langsplat_core.scene import Camera
from langsplat_viewer.controls import OrbitCamera, between, focus, from_camera
from langsplat_viewer.state import GLIDE_SECONDS, Glide, Query
from langsplat_viewer.viewer import Viewer


def tick(viewer: Viewer, now: float) -> None:
    """Start of a frame at `now` seconds: take what the worker finished and move a gliding camera on."""
    viewer.clock = now
    viewer.worker.poll()
    glide = viewer.state.glide
    if glide is not None:
        t = (now - glide.began) / GLIDE_SECONDS
        viewer.state.view = between(glide.start, glide.end, t)
        if t >= 1:
            viewer.state.glide = None


def move(viewer: Viewer, step: Callable[[OrbitCamera], OrbitCamera]) -> None:
    """Apply one of the functions of `controls` at once; it ends a glide."""
    if viewer.state.view is not None:
        viewer.state.view, viewer.state.glide = step(viewer.state.view), None


def stand_at(viewer: Viewer, camera: Camera) -> None:
    """Take a camera's view at once."""
    extent = viewer.state.extent
    if extent is not None:
        move(viewer, lambda view: from_camera(camera, extent))


def glide_to(viewer: Viewer, end: OrbitCamera) -> None:
    """Move smoothly to a view."""
    if viewer.state.view is not None:
        viewer.state.glide = Glide(viewer.state.view, end, viewer.clock)


def set_fly_speed(viewer: Viewer, speed: float) -> None:
    """How fast the keys fly, scene radii per second."""
    viewer.state.fly_speed = speed


def reset_view(viewer: Viewer) -> None:
    """Frame the whole scene, upright."""
    extent = viewer.state.extent
    if extent is not None:
        glide_to(viewer, from_camera(extent.home, extent))


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
    """Bring a query's place to the centre, at a distance that shows its surroundings; without `query` the
    latest one shown that was found; without any the middle of the scene."""
    state, extent = viewer.state, viewer.state.extent
    if extent is None or state.view is None:
        return
    if query is None:
        found = [q for q in state.queries if q.slot is not None and q.result and q.result.found]
        query = found[-1] if found else None
    if query is None or query.result is None or query.result.place is None:
        glide_to(viewer, focus(state.view, extent.centre, 2.6 * extent.radius))
        return
    box = query.result.box
    size = 0.1 * extent.radius if box is None else float(np.linalg.norm(box[1] - box[0]))
    near = 0.5 * extent.radius
    glide_to(viewer, focus(state.view, query.result.place, max(near, min(2.5 * size, state.view.distance))))


def focus_pixel(viewer: Viewer, u: float, v: float) -> None:
    """Turn around the surface under the cursor from now on; (u, v) are fractions of the scene's area."""
    if viewer.surface is None or viewer.state.view is None:
        return
    point = viewer.surface.point_at(u, v)
    if point is None:
        viewer.state.say("nothing under the cursor to turn around")
        return
    depth = float((point - viewer.state.view.eye) @ viewer.state.view.rotation[2])
    glide_to(viewer, focus(viewer.state.view, point, depth))
