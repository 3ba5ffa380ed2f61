"""The viewpoint: camera moves, the camera path and its keyframes, the cursor, bookmarks."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError, printable_line
from langsplat_core.progress import Progress
from langsplat_core.query.describe import Describer, Pointed, look_at_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Camera
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.camera import controls, flight
from langsplat_viewer.camera.controls import Extent, OrbitCamera, Sample, Side
from langsplat_viewer.camera.flight import Keyframe
from langsplat_viewer.projects import MOST_KEYFRAMES, read_flight
from langsplat_viewer.rendering.request import Split, image_formation
from langsplat_viewer.session import LONGEST_NAME, MOST_BOOKMARKS, Bookmark, Query
from langsplat_viewer.state import GLIDE_SECONDS, SPACING, Glide, Hover, OpenScene, flight_of
from langsplat_viewer.viewer import Viewer, needs_scene

# Camera moves, at once or gliding from view to view.

NEAREST = 0.004  # of the scene's radius: the closest that the eye comes to its centre of turning


def tick(viewer: Viewer, now: float) -> None:
    """Begin a frame at `now` seconds: advance a glide, or a path that is played."""
    viewer.clock = now
    glide = viewer.state.glide
    if glide is not None:
        t = (now - glide.began) / GLIDE_SECONDS
        viewer.state.look(controls.between(glide.start, glide.end, t))
        if t >= 1:
            viewer.state.glide = None
    _play(viewer)


@needs_scene()
def move(viewer: Viewer, seen: OpenScene, step: Callable[[OrbitCamera], OrbitCamera]) -> None:
    """Apply one of the functions of `controls` at once; it ends a glide."""
    viewer.state.record.began = viewer.state.glide = None
    viewer.state.look(step(seen.view))


@needs_scene()
def glide_to(viewer: Viewer, seen: OpenScene, end: OrbitCamera) -> None:
    """Send the camera to a view."""
    viewer.state.record.began = None
    viewer.state.glide = Glide(seen.view, end, viewer.clock)


@needs_scene()
def open_at(viewer: Viewer, seen: OpenScene, camera: Camera) -> None:
    """Take a camera's view at once; it is the opening view from now on."""
    same = [np.array_equal(own.world_to_camera, camera.world_to_camera) for own in seen.scene.cameras]
    viewer.state.camera_index = same.index(True) if any(same) else None
    viewer.state.open = replace(seen, opening_camera=camera)
    move(viewer, lambda view: controls.from_camera(camera, seen.extent))


@needs_scene()
def zoom_by(viewer: Viewer, seen: OpenScene, factor: float) -> None:
    """Multiply the distance to the centre of turning, within limits set by the scene's size."""
    nearest, farthest = NEAREST * seen.extent.radius, seen.extent.farthest
    move(viewer, lambda view: controls.zoom(view, factor, nearest, farthest))


def opening_view(seen: OpenScene, size: tuple[int, int]) -> OrbitCamera:
    """Return the first view of a scene in an area of `size` pixels.

    It is the requested camera, else the first training camera, else a view of the whole scene.
    """
    if seen.opening_camera is not None:
        return controls.from_camera(seen.opening_camera, seen.extent)
    return controls.default_view(seen.scene, seen.extent, size)


@needs_scene()
def reset_view(viewer: Viewer, seen: OpenScene) -> None:
    """Return to the opening view, in the current projection; to a view of both scenes if it shows one."""
    size = viewer.state.size
    view = opening_view(seen, size)
    if seen.view.orthographic:
        view = replace(view, orthographic=True)
        if seen.opening_camera is None and not seen.scene.cameras:
            view = controls.frame_all(view, seen.extent, size)
    if (other := _compared(viewer)) is not None:
        camera = view.camera(*size)
        if not camera.in_image(*camera.project(other.points)).any():
            is_left = (other.points.mean(0) - seen.extent.centre) @ view.rotation[0] < 0
            view = controls.orbit(view, np.pi * is_left, 0)  # it is drawn right of the line
            view = controls.frame_all(view, controls.joined(seen.extent, other), size)
    glide_to(viewer, view)


def _compared(viewer: Viewer) -> Sample | None:
    """Return the sample of a scene that is compared, in the coordinates of the first."""
    seen = None if viewer.beside is None else viewer.beside.state.open
    if seen is None:
        return None
    sample = seen.extent.sample
    return replace(sample, points=sample.points + (seen.scene.origin - viewer.state.origin))


@needs_scene()
def frame_scene(viewer: Viewer, seen: OpenScene) -> None:
    """Show the whole scene, and one that is compared, from the current direction."""
    other = _compared(viewer)
    extent = seen.extent if other is None else controls.joined(seen.extent, other)
    glide_to(viewer, controls.frame_all(seen.view, extent, viewer.state.size))


@needs_scene()
def look_from(viewer: Viewer, seen: OpenScene, side: Side) -> None:
    """Turn the view to look along a world axis, at the same target from the same distance."""
    glide_to(viewer, controls.from_side(seen.view, side))


@needs_scene()
def toggle_orthographic(viewer: Viewer, seen: OpenScene) -> None:
    """Switch between perspective and orthographic projection; a glide under way goes on."""
    orthographic, glide = not seen.view.orthographic, viewer.state.glide
    move(viewer, lambda view: replace(view, orthographic=orthographic))
    if glide is not None:
        viewer.state.glide = replace(glide, end=replace(glide.end, orthographic=orthographic))


@needs_scene()
def go_to_camera(viewer: Viewer, seen: OpenScene, index: int) -> None:
    """Stand where a training photograph was taken; indices beyond the ends wrap round."""
    if not seen.scene.cameras:
        viewer.say_error("this scene has no training cameras (no .cameras.json beside it)")
        return
    viewer.state.camera_index = index % len(seen.scene.cameras)
    glide_to(viewer, controls.from_camera(seen.scene.cameras[viewer.state.camera_index], seen.extent))


def step_camera(viewer: Viewer, by: int) -> None:
    """Go to the next (1) or previous (-1) training camera."""
    go_to_camera(viewer, (viewer.state.camera_index or 0) + by)


def focus_result(viewer: Viewer, query: Query | None = None) -> None:
    """Bring a query's place to the centre, at a distance that suits the size of the thing.

    Without `query` the latest one shown that was found; without any the whole scene.
    """
    state = viewer.state
    shown = state.session.in_order_of_showing() if query is None else [query]
    state.uncovered = ()
    results = [result for query in shown if (result := state.result(query)) is not None]
    found = [result for result in results if result.found or query is not None]
    if found and found[-1].place is not None:
        focus_on(viewer, found[-1].place, found[-1].box)
    else:
        frame_scene(viewer)


@needs_scene()
def focus_on(viewer: Viewer, seen: OpenScene, place: Array, box: Array | None) -> None:
    """Bring a thing at `place` (3,) in `box` (2, 3) to the centre, at a distance that suits its size.

    The eye is no farther from it than now or in the opening view: beyond that, in a room, is its wall.
    """
    view, radius, home = seen.view, seen.extent.radius, opening_view(seen, viewer.state.size)
    if box is None:
        box = np.stack([place, place + 0.1 * radius])
    most = max(float(np.linalg.norm(place - view.eye)), home.distance)
    angle = np.radians(min(view.intrinsics.fov_degrees, 170.0))  # the box takes about half of it
    holding = controls.SURROUNDINGS * 0.5 * float(np.linalg.norm(box[1] - box[0]) / np.sin(angle / 2))
    distance = min(max(holding, NEAREST * radius), most)
    glide_to(viewer, controls.focus(view, place, distance))


@needs_scene()
def move_aside(viewer: Viewer, seen: OpenScene, points: Array, left: float, right: float) -> None:
    """Glide sideways until (M, 3) points lie beside what covers the image from `left` to `right`.

    Both are fractions of its width. What is wider than the room beside it comes to the middle of that.
    """
    view, (width, height) = seen.view, viewer.state.size
    if viewer.state.record.began is not None:
        return
    pixels, depths = view.camera(width, height).project(points)
    near, far = pixels[:, 0].min() / width, pixels[:, 0].max() / width
    start, end = (right, 1.0) if left + right < 1 else (0.0, left)
    by = start - near if left + right < 1 else end - far
    if far - near > end - start:
        by = (start + end - near - far) / 2
    scale = 1.0 if view.orthographic else float(depths.mean()) / view.distance
    glide_to(viewer, controls.pan(view, by * width * scale, 0, (width, height)))


@needs_scene()
def focus_pixel(viewer: Viewer, seen: OpenScene, u: float, v: float) -> None:
    """Make the surface under the cursor the centre of turning; (u, v) are fractions of the scene's area."""
    view, point = seen.view, viewer.point_at(u, v, "turn around")
    if point is not None:
        # The eye stays, but without perspective the size of things does.
        depth = None if view.orthographic else float((np.array(point) - view.eye) @ view.rotation[2])
        glide_to(viewer, controls.focus(view, np.array(point), depth))


# The camera path as it is played.


def path_seconds(viewer: Viewer) -> float:
    """Return how long the path takes, seconds; 0 without one."""
    keyframes = viewer.state.session.keyframes
    return keyframes[-1].seconds if keyframes else 0.0


@needs_scene("play a path in it")
def toggle_playing(viewer: Viewer, seen: OpenScene) -> None:
    """Play the path from where it is, or stop there."""
    record = viewer.state.record
    if record.began is not None:
        record.began = None
    elif path_seconds(viewer) <= 0:
        viewer.say_error("a path needs two keyframes: add one at the current view")
    else:
        start = 0.0 if record.at >= path_seconds(viewer) else record.at
        scrub(viewer, start)
        record.began = viewer.clock - start


def scrub(viewer: Viewer, seconds: float) -> None:
    """Show the path at a time, stopped."""
    viewer.state.record.began = viewer.state.glide = None
    _show(viewer, min(max(seconds, 0.0), path_seconds(viewer)))


def _play(viewer: Viewer) -> None:
    """Advance a played path to the viewer's clock; at its end it stops, or begins again."""
    record = viewer.state.record
    if record.began is None:
        return
    seconds, at = path_seconds(viewer), viewer.clock - record.began
    if viewer.state.open is None or seconds <= 0:
        record.began = None
        return
    if at >= seconds and record.loops:
        at %= seconds
        record.began = viewer.clock - at
    elif at >= seconds:
        record.began = None
    _show(viewer, min(at, seconds))


def _show(viewer: Viewer, seconds: float) -> None:
    state = viewer.state
    if state.open is not None and state.session.keyframes:
        state.record.at, pose = seconds, flight.pose_at(flight_of(state.session.keyframes), seconds)
        state.look(flight.view_of(pose, state.open.extent))


# Keyframes of the path.

THUMBNAIL, MOST_THUMBNAILS = (144, 90), 64  # pixels
TURN_SECONDS = 8.0  # duration of a turn, until another is set
SLOW = 250.0  # milliseconds of a full image of the window above which there are no thumbnails


@needs_scene("record a path in it")
def add_keyframe(viewer: Viewer, seen: OpenScene) -> None:
    """Add the current view as a keyframe, some seconds after the last one."""
    keyframes = viewer.state.session.keyframes
    last = keyframes[-1].seconds + SPACING if keyframes else 0.0
    if last > flight.LONGEST or len(keyframes) >= MOST_KEYFRAMES:
        viewer.say_error(f"a path has at most {MOST_KEYFRAMES} keyframes and {flight.LONGEST:.0f} seconds")
        return
    added = Keyframe(last, flight.pose_of(seen.view))
    set_path(viewer, (*keyframes, added), added)
    viewer.state.say(f"keyframe {len(keyframes) + 1} at {added.seconds:.1f} s")


@needs_scene("turn around in it")
def turn_around(viewer: Viewer, seen: OpenScene) -> None:
    """Replace the path by one turn around the view's target."""
    set_path(viewer, flight.turntable(seen.view, TURN_SECONDS).keyframes)
    viewer.state.record.at = 0.0
    viewer.state.say(f"the path is one turn of {TURN_SECONDS:.0f} s: Shift+K plays it")


@needs_scene()
def choose_keyframe(viewer: Viewer, seen: OpenScene, key: Keyframe) -> None:
    """Go to a keyframe."""
    glide_to(viewer, flight.view_of(key.pose, seen.extent))
    viewer.state.record.chosen, viewer.state.record.at = key, key.seconds


def thumbnails(viewer: Viewer) -> Mapping[Keyframe, Array]:
    """Return the first keyframes as they look in colours, (height, width, 3) uint8 each.

    Each frame draws one more; none where images are slow.
    """
    state, keys = viewer.state, viewer.state.session.keyframes[:MOST_THUMBNAILS]
    made = {key: image for key, image in state.record.thumbnails.items() if key in keys}
    missing = next((key for key in keys if key not in made), None)
    is_quick = state.stats.scale == 1 and state.stats.milliseconds < SLOW
    if missing and viewer.surface and state.open and is_quick:
        camera = flight.view_of(missing.pose, state.open.extent).camera(*THUMBNAIL)
        request = replace(state.request(THUMBNAIL), camera=camera, split=Split(), answers=())
        picture = replace(request.picture, display="rgb")
        made[missing] = viewer.surface.capture(replace(request, picture=picture))
        viewer.worker.wake()  # for the next one
    state.record.thumbnails = made
    return made


def put_keyframe(viewer: Viewer, key: Keyframe, new: Keyframe | None = None) -> None:
    """Replace a keyframe by `new`, moved off the times of others; None: take the keyframe off."""
    kept = tuple(other for other in viewer.state.session.keyframes if other is not key)
    if new is not None:
        seconds = min(max(new.seconds, 0.0), flight.LONGEST)
        while any(abs(other.seconds - seconds) < flight.SAME_TIME for other in kept):
            seconds += 0.01
        new = replace(new, seconds=seconds)
        kept = tuple(sorted((*kept, new), key=lambda key: key.seconds))
    set_path(viewer, kept, new)


def set_path_seconds(viewer: Viewer, seconds: float) -> None:
    """Set how long the path takes."""
    keyframes, seconds = viewer.state.session.keyframes, min(max(seconds, 0.1), flight.LONGEST)
    set_path(viewer, flight.stretched(keyframes, max(seconds, len(keyframes) * flight.SAME_TIME)), None)


def set_path(viewer: Viewer, keyframes: tuple[Keyframe, ...], chosen: Keyframe | None = None) -> None:
    """Set the keyframes, and which one is chosen."""
    viewer.change(keyframes=keyframes)
    record = viewer.state.record
    record.began, record.chosen = None, chosen
    record.at = chosen.seconds if chosen is not None else min(record.at, path_seconds(viewer))


def load_path(viewer: Viewer, path: Path) -> None:
    """Replace the path by that of a file."""
    try:
        found = read_flight(path).moved(-viewer.state.origin)
    except LangSplatError as error:
        viewer.say_error(str(error))
        return
    set_path(viewer, found.keyframes, None)
    count_path_as_saved(viewer)
    viewer.state.record.at = 0.0
    open_panel(viewer, "Record")
    viewer.state.say(f"{path.name}: {len(found.keyframes)} keyframes, {found.seconds:.1f} s")


def count_path_as_saved(viewer: Viewer) -> None:
    """Count the keyframes as saved: a file has them. A project that has others is still to be saved."""
    saved, keyframes = viewer.state.saved, viewer.state.session.keyframes
    if saved.project is None:
        viewer.state.saved = replace(saved, session=replace(saved.session, keyframes=keyframes))


# The cursor: the words for the point under it while it rests.

REST_SECONDS = 0.2  # rest of the mouse after which the point under it is queried


def toggle_pointing(viewer: Viewer) -> None:
    """Switch the tooltip about the point under the cursor on or off."""
    state = viewer.state
    if state.pointing or viewer.searchable() is not None:
        state.pointing, state.hover = not state.pointing, None


def hover(viewer: Viewer, pixel: tuple[int, int] | None) -> None:
    """Note the pixel (column, row) that the mouse is over in this frame; None: elsewhere, or it drags.

    The point under it is queried once the mouse and the camera rest.
    """
    state, before, (width, height) = viewer.state, viewer.state.hover, viewer.state.size
    inside = pixel is not None and 0 <= pixel[0] < width and 0 <= pixel[1] < height
    if not state.pointing or state.open is None or pixel is None or not inside:
        state.hover = None
    elif before is None or (before.pixel, before.view) != (pixel, state.open.view):
        state.hover = Hover(pixel, state.open.view, viewer.clock)
    elif not before.asked and viewer.clock - before.since >= REST_SECONDS and viewer.worker.current is None:
        before.asked = True
        _ask(viewer, before)


def _ask(viewer: Viewer, place: Hover) -> None:
    camera, clip = place.view.camera(*viewer.state.size), viewer.state.session.clip
    phrases = tuple(query.phrase for query in viewer.state.shown() if query is not None)
    results = [result for result in viewer.state.shown_results() if result is not None]

    def work(engine: QueryEngine, progress: Progress) -> tuple[Describer, Pointed | None]:
        settings = image_formation(engine.scene, camera, clip)
        describer = viewer.describing(engine, progress)
        return describer, look_at_pixel(describer, camera, place.pixel, results, settings=settings)

    def done(found: tuple[Describer, Pointed | None]) -> None:
        viewer.describer, place.found = found
        place.phrases = phrases

    viewer.ask_engine("looking under the cursor", work, done)


# Bookmarks.


@needs_scene("bookmark a view of it")
def add_bookmark(viewer: Viewer, seen: OpenScene, name: str = "") -> None:
    """Add the current view, replacing one of the same name. Without a name it gets a number."""
    kept = viewer.state.session.bookmarks
    if not name.strip():
        taken, number = {bookmark.name for bookmark in kept}, len(kept) + 1
        name = next(f"view {n}" for n in range(number, 2 * number) if f"view {n}" not in taken)
    added = Bookmark(printable_line(name, LONGEST_NAME), flight.pose_of(seen.view), seen.view.distance)
    others = tuple(bookmark for bookmark in kept if bookmark.name != added.name)
    if len(others) >= MOST_BOOKMARKS:
        viewer.say_error(f"a scene has at most {MOST_BOOKMARKS} bookmarks: delete one")
        return
    viewer.change(bookmarks=(*others, added))
    viewer.state.say(f"bookmark '{added.name}'")


def bookmarked_view(bookmark: Bookmark, extent: Extent) -> OrbitCamera:
    """Return the view of a bookmark."""
    view = flight.view_of(bookmark.pose, extent)
    return controls.focus(view, view.eye + bookmark.distance * view.rotation[2], bookmark.distance)
