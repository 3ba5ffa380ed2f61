"""Settings of what is shown and how: displays side by side, overlays, the ruler; which panels are seen."""

from dataclasses import fields, replace
from typing import Any

from langsplat_core.config import ColourMap, Display, PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.engine import no_field
from langsplat_viewer.actions.selecting import leave_tool, stay
from langsplat_viewer.rendering.request import AT_RANGE, Clip, SplitMode
from langsplat_viewer.session import OVERLAYS, Overlay, Ruler
from langsplat_viewer.state import Recording, ViewerState
from langsplat_viewer.viewer import Viewer


def put(part: ViewerState | Recording, **values: object) -> None:
    """Take what was typed or switched, where nothing follows from it.

    `values` are fields of the state or a part of it, by name. Panels write nothing themselves.
    """
    for name, value in values.items():
        getattr(part, name)  # AttributeError where it has none
        setattr(part, name, value)


def take(part: ViewerState | Recording, name: str) -> Any:
    """Return a field that is wanted for one frame, and empty it."""
    value = getattr(part, name)
    setattr(part, name, type(value)())
    return value


def set_display(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Choose what is shown; `latent_level` is an index into `scene.LEVELS`."""
    if _can_show(viewer, DISPLAYS[display].needs_field):
        session = viewer.state.session
        level = session.latent_level if latent_level is None else latent_level
        viewer.change(picture=replace(session.picture, display=display), latent_level=level)


def set_picture(viewer: Viewer, picture: PictureConfig) -> None:
    """Take other settings of the image, as its sliders give them."""
    before, names = viewer.state.session.picture, (field.name for field in fields(picture))
    changed = (name for name in names if getattr(picture, name) != getattr(before, name))
    viewer.change(" ".join(changed), picture=picture)


def set_colour_map(viewer: Viewer, colour_map: ColourMap) -> None:
    """Set the colours of relevancy and depth."""
    viewer.change(picture=replace(viewer.state.session.picture, colour_map=colour_map))


def set_clip(viewer: Viewer, clip: Clip) -> None:
    """Set between which depths Gaussians are drawn; the far one stays the farther."""
    near = max(clip.near, 0.0)
    viewer.change("clip", clip=Clip(near, max(clip.far, near)))


# Several displays side by side.


def compare_with(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Show a second display right of a line across the scene; `latent_level` indexes `scene.LEVELS`."""
    split = viewer.state.session.split
    level = split.second_level if latent_level is None else latent_level
    if _can_show(viewer, DISPLAYS[display].needs_field):
        viewer.change(split=replace(split, mode="wipe", second=display, second_level=level))


def set_split(viewer: Viewer, mode: SplitMode) -> None:
    """Choose how the scene's area is divided."""
    viewer.change(split=replace(viewer.state.session.split, mode=mode))


def toggle_wipe(viewer: Viewer) -> None:
    """Show the second display beside the first, or the first alone."""
    split = viewer.state.session.split
    if split.mode == "wipe":
        set_split(viewer, "off")
    else:
        compare_with(viewer, split.second)


def toggle_levels(viewer: Viewer) -> None:
    """Show the three levels side by side, or one image."""
    if viewer.state.session.split.mode == "levels":
        set_split(viewer, "off")
    elif _can_show(viewer, needs_field=True):
        set_split(viewer, "levels")


def move_line(viewer: Viewer, at: float) -> None:
    """Move the line that divides the two images, as a fraction of the area's width."""
    low, high = AT_RANGE
    viewer.change("line", split=replace(viewer.state.session.split, at=min(max(at, low), high)))


def _can_show(viewer: Viewer, needs_field: bool) -> bool:
    """Return whether the scene has a language field where one is needed; says so where it has none."""
    scene = viewer.state.scene
    if needs_field and scene is not None and scene.language is None:
        viewer.say_error(no_field(scene))
        return False
    return True


# Overlays, and the ruler.


def toggle_overlay(viewer: Viewer, overlay: Overlay) -> None:
    """Lay something over the scene, or take it away."""
    kept = {*viewer.state.session.overlays} ^ {overlay}
    viewer.change(overlays=tuple(name for name in OVERLAYS if name in kept))


def measure(viewer: Viewer, on: bool) -> None:
    """Set whether clicks on the scene set the points of the ruler; what was measured goes when it ends."""
    if on != viewer.state.session.ruler.measures:
        viewer.put(ruler=Ruler(on))


def toggle_measuring(viewer: Viewer) -> None:
    """Begin to measure, or end it."""
    measure(viewer, not viewer.state.session.ruler.measures)


def measure_at(viewer: Viewer, u: float, v: float) -> None:
    """Set a point of the ruler on the surface; (u, v) are fractions of the scene's area."""
    point = None if viewer.surface is None else viewer.surface.point_at(u, v)
    if point is None:
        viewer.state.say("nothing under the cursor to measure from")
        return
    x, y, z = (float(part) for part in point)
    viewer.put(ruler=viewer.state.session.ruler.with_point((x, y, z)))


# The window: preferences and panels.


def prefer(viewer: Viewer, **values: Any) -> None:
    """Change fields of the preferences."""
    preferences = replace(viewer.state.preferences, **values)
    if preferences != viewer.state.preferences:
        viewer.state.preferences = preferences


def keep_preferences(viewer: Viewer) -> None:
    """Have the preferences keep what outlives a window of the session's settings."""
    session = viewer.state.session
    prefer(viewer, colour_map=session.picture.colour_map, overlays=session.overlays)


def take_preferences(viewer: Viewer) -> None:
    """Begin the session with the settings that outlived the last window."""
    kept, picture = viewer.state.preferences, viewer.state.session.picture
    overlays = tuple(name for name in OVERLAYS if name in kept.overlays)
    viewer.put(picture=replace(picture, colour_map=kept.colour_map), overlays=overlays)


def resize(viewer: Viewer, width: int, height: int) -> None:
    """Take the size of the scene's area of the window, pixels."""
    viewer.state.size = (max(1, width), max(1, height))


def toggle_panel(viewer: Viewer) -> None:
    """Hide all panels, or bring them back."""
    viewer.state.show_panel = not viewer.state.show_panel


def open_panel(viewer: Viewer, title: str) -> None:
    """Have a panel opened, in front of those it shares its place with."""
    viewer.state.show_panel, viewer.state.wanted_panel = True, title


def reset_panels(viewer: Viewer) -> None:
    """Put the panels where they are at first."""
    viewer.state.show_panel = viewer.state.resets_panels = True


def toggle_help(viewer: Viewer) -> None:
    """Show or close the help."""
    viewer.state.show_help = not viewer.state.show_help


def show_palette(viewer: Viewer, shown: bool) -> None:
    """Set whether the list of everything that can be done is there."""
    viewer.state.show_palette = shown
    viewer.state.awaits_keyboard |= shown


def toggle_palette(viewer: Viewer) -> None:
    """Show or close the list of commands."""
    show_palette(viewer, not viewer.state.show_palette)


def escape(viewer: Viewer) -> None:
    """Close what lies over the scene; where nothing did, leave the tool."""
    state = viewer.state
    lay_over = state.show_help or state.show_palette or state.browser or state.leaving
    state.show_help = state.pins_notes = False
    show_palette(viewer, False)
    measure(viewer, False)
    state.browser = None
    stay(viewer)
    if not lay_over:
        leave_tool(viewer)
