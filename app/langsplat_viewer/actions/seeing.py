"""Several pictures side by side, and what lies over them."""

from dataclasses import replace

from langsplat_core.config import ColourMap, Display
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.engine import no_field
from langsplat_viewer.actions.camera import glide_to
from langsplat_viewer.actions.history import remember
from langsplat_viewer.camera.view_cube import facing
from langsplat_viewer.drawing.seeing import (
    AT_RANGE,
    MOST_DEGREE,
    OVERLAYS,
    SIZE_RANGE,
    Clip,
    Overlay,
    Ruler,
    Seeing,
    Splats,
    Split,
)
from langsplat_viewer.viewer import Viewer


def compare_with(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Show a second display right of a line across the scene; `latent_level` indexes `scene.LEVELS`."""
    split = viewer.state.seeing.split
    level = split.second_level if latent_level is None else latent_level
    if _can_show(viewer, DISPLAYS[display].needs_field):
        _set_split(viewer, replace(split, mode="wipe", second=display, second_level=level))


def toggle_wipe(viewer: Viewer) -> None:
    """Show the second display that was chosen last, or one picture again."""
    split = viewer.state.seeing.split
    if split.mode == "wipe":
        show_one(viewer)
    else:
        compare_with(viewer, split.second)


def toggle_levels(viewer: Viewer) -> None:
    """Show the three semantic levels side by side, or one picture again."""
    split = viewer.state.seeing.split
    if split.mode == "levels":
        show_one(viewer)
    elif _can_show(viewer, needs_field=True):
        _set_split(viewer, replace(split, mode="levels"))


def show_one(viewer: Viewer) -> None:
    """One picture fills the scene's area."""
    _set_split(viewer, replace(viewer.state.seeing.split, mode="off"))


def move_line(viewer: Viewer, at: float) -> None:
    """Where the line is that divides the two pictures, as a fraction of the area's width."""
    low, high = AT_RANGE
    _set_split(viewer, replace(viewer.state.seeing.split, at=min(max(at, low), high)), "line")


def set_colour_map(viewer: Viewer, colour_map: ColourMap) -> None:
    """The colours of relevancy and depth; remembered."""
    state = viewer.state
    if colour_map != state.picture.colour_map:
        remember(viewer)
    state.picture = replace(state.picture, colour_map=colour_map)
    state.preferences = replace(state.preferences, colour_map=colour_map)


def save_transparent(viewer: Viewer, transparent: bool) -> None:
    """Whether pictures are saved without their background."""
    _see(viewer, replace(viewer.state.seeing, transparent=transparent))


def set_splats(viewer: Viewer, splats: Splats) -> None:
    """How the Gaussians are drawn, within what there is."""
    low, high = SIZE_RANGE
    degree = min(max(splats.sh_degree, 0), MOST_DEGREE)
    kept = Splats(min(max(splats.size, low), high), degree)
    _see(viewer, replace(viewer.state.seeing, splats=kept), "splats")


def set_clip(viewer: Viewer, clip: Clip) -> None:
    """Between which depths Gaussians are drawn; the far one stays the farther."""
    near = max(clip.near, 0.0)
    kept = Clip(near, max(clip.far, near))
    _see(viewer, replace(viewer.state.seeing, clip=kept), "clip")


def show_overlay(viewer: Viewer, overlay: Overlay, shown: bool) -> None:
    """Whether something lies over the scene; remembered."""
    preferences = viewer.state.preferences
    kept = {*preferences.overlays, overlay} if shown else {*preferences.overlays} - {overlay}
    overlays = tuple(name for name in OVERLAYS if name in kept)
    if overlays != preferences.overlays:
        remember(viewer)
        viewer.state.preferences = replace(preferences, overlays=overlays)


def toggle_overlay(viewer: Viewer, overlay: Overlay) -> None:
    """Show it, or take it away."""
    show_overlay(viewer, overlay, overlay not in viewer.state.preferences.overlays)


def turn_to_face(viewer: Viewer, face: str) -> None:
    """Look straight at one face of the view cube, by its name in `view_cube.FACES`."""
    if viewer.state.view is not None:
        glide_to(viewer, facing(viewer.state.view, face))


def measure(viewer: Viewer, on: bool) -> None:
    """Whether clicks on the scene set the points of the ruler; what was measured goes when it ends."""
    ruler = viewer.state.seeing.ruler
    if on != ruler.measures:
        viewer.state.seeing = replace(viewer.state.seeing, ruler=Ruler(on))


def toggle_measuring(viewer: Viewer) -> None:
    """Begin to measure, or end it."""
    measure(viewer, not viewer.state.seeing.ruler.measures)


def measure_at(viewer: Viewer, u: float, v: float) -> None:
    """Set a point of the ruler on the surface; (u, v) are fractions of the scene's area."""
    point = None if viewer.surface is None else viewer.surface.point_at(u, v)
    if point is None:
        viewer.state.say("nothing under the cursor to measure from")
        return
    x, y, z = (float(part) for part in point)
    seeing = viewer.state.seeing
    viewer.state.seeing = replace(seeing, ruler=seeing.ruler.with_point((x, y, z)))


def _can_show(viewer: Viewer, needs_field: bool) -> bool:
    """Whether the scene has a language field where one is needed; says so where it has none."""
    scene = viewer.state.scene
    if needs_field and scene is not None and scene.language is None:
        viewer.state.say(no_field(scene), is_error=True)
        return False
    return True


def _set_split(viewer: Viewer, split: Split, setting: str = "") -> None:
    _see(viewer, replace(viewer.state.seeing, split=split), setting)


def _see(viewer: Viewer, seeing: Seeing, setting: str = "") -> None:
    """Look at the scene like that; `setting` as in `remember`."""
    if seeing != viewer.state.seeing:
        remember(viewer, setting)
        viewer.state.seeing = seeing
