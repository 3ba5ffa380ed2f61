"""Settings of what is shown and how: several images side by side, overlays, display, panels, help."""

from dataclasses import fields, replace

from langsplat_core.config import ColourMap, Display, PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.engine import no_field
from langsplat_viewer.actions.selecting import leave_tool, stay
from langsplat_viewer.actions.viewpoint import glide_to
from langsplat_viewer.camera.overlays import facing
from langsplat_viewer.files.preferences import SCALES, Theme
from langsplat_viewer.rendering.request import AT_RANGE, MOST_DEGREE, SIZE_RANGE, Clip, Splats, Split
from langsplat_viewer.state import OVERLAYS, Overlay, Recording, Ruler, Timing, ViewerState, ViewSettings
from langsplat_viewer.viewer import Viewer, remember


def compare_with(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Show a second display right of a line across the scene; `latent_level` indexes `scene.LEVELS`."""
    split = viewer.state.settings.split
    level = split.second_level if latent_level is None else latent_level
    if _can_show(viewer, DISPLAYS[display].needs_field):
        _set_split(viewer, replace(split, mode="wipe", second=display, second_level=level))


def toggle_wipe(viewer: Viewer) -> None:
    split = viewer.state.settings.split
    if split.mode == "wipe":
        show_one(viewer)
    else:
        compare_with(viewer, split.second)


def toggle_levels(viewer: Viewer) -> None:
    split = viewer.state.settings.split
    if split.mode == "levels":
        show_one(viewer)
    elif _can_show(viewer, needs_field=True):
        _set_split(viewer, replace(split, mode="levels"))


def show_scenes(viewer: Viewer) -> None:
    _set_split(viewer, replace(viewer.state.settings.split, mode="scenes"))


def show_one(viewer: Viewer) -> None:
    _set_split(viewer, replace(viewer.state.settings.split, mode="off"))


def move_line(viewer: Viewer, at: float) -> None:
    """Move the line that divides the two images, as a fraction of the area's width."""
    low, high = AT_RANGE
    _set_split(viewer, replace(viewer.state.settings.split, at=min(max(at, low), high)), "line")


def set_colour_map(viewer: Viewer, colour_map: ColourMap) -> None:
    """Set the colours of relevancy and depth; remembered."""
    state = viewer.state
    if colour_map != state.picture.colour_map:
        remember(viewer)
    state.picture = replace(state.picture, colour_map=colour_map)
    state.preferences = replace(state.preferences, colour_map=colour_map)


def save_transparent(viewer: Viewer, transparent: bool) -> None:
    """Set whether images are saved without their background."""
    _set(viewer, replace(viewer.state.settings, transparent=transparent))


def set_splats(viewer: Viewer, splats: Splats) -> None:
    """Set how the Gaussians are drawn, within the range of settings."""
    low, high = SIZE_RANGE
    degree = min(max(splats.sh_degree, 0), MOST_DEGREE)
    kept = Splats(min(max(splats.size, low), high), degree)
    _set(viewer, replace(viewer.state.settings, splats=kept), "splats")


def set_clip(viewer: Viewer, clip: Clip) -> None:
    """Set between which depths Gaussians are drawn; the far one stays the farther."""
    near = max(clip.near, 0.0)
    kept = Clip(near, max(clip.far, near))
    _set(viewer, replace(viewer.state.settings, clip=kept), "clip")


def show_overlay(viewer: Viewer, overlay: Overlay, shown: bool) -> None:
    """Set whether something lies over the scene; remembered."""
    preferences = viewer.state.preferences
    kept = {*preferences.overlays, overlay} if shown else {*preferences.overlays} - {overlay}
    overlays = tuple(name for name in OVERLAYS if name in kept)
    if overlays != preferences.overlays:
        remember(viewer)
        viewer.state.preferences = replace(preferences, overlays=overlays)


def toggle_overlay(viewer: Viewer, overlay: Overlay) -> None:
    show_overlay(viewer, overlay, overlay not in viewer.state.preferences.overlays)


def turn_to_face(viewer: Viewer, face: str) -> None:
    """Look straight at one face of the view cube, by its name in `camera.overlays.FACES`."""
    if viewer.state.view is not None:
        glide_to(viewer, facing(viewer.state.view, face))


def measure(viewer: Viewer, on: bool) -> None:
    """Set whether clicks on the scene set the points of the ruler; what was measured goes when it ends."""
    ruler = viewer.state.ruler
    if on != ruler.measures:
        viewer.state.ruler = Ruler(on)


def toggle_measuring(viewer: Viewer) -> None:
    measure(viewer, not viewer.state.ruler.measures)


def measure_at(viewer: Viewer, u: float, v: float) -> None:
    """Set a point of the ruler on the surface; (u, v) are fractions of the scene's area."""
    point = None if viewer.surface is None else viewer.surface.point_at(u, v)
    if point is None:
        viewer.state.say("nothing under the cursor to measure from")
        return
    x, y, z = (float(part) for part in point)
    viewer.state.ruler = viewer.state.ruler.with_point((x, y, z))


def _can_show(viewer: Viewer, needs_field: bool) -> bool:
    """Return whether the scene has a language field where one is needed; says so where it has none."""
    scene = viewer.state.scene
    if needs_field and scene is not None and scene.language is None:
        viewer.say_error(no_field(scene))
        return False
    return True


def _set_split(viewer: Viewer, split: Split, setting: str = "") -> None:
    _set(viewer, replace(viewer.state.settings, split=split), setting)


def _set(viewer: Viewer, settings: ViewSettings, setting: str = "") -> None:
    """Take other view settings; `setting` as in `remember`."""
    if settings != viewer.state.settings:
        remember(viewer, setting)
        viewer.state.settings = settings


# What is shown and how; which parts of the window are.


def put(part: ViewerState | Recording | Timing, **values: object) -> None:
    """Take what was typed or switched, where nothing follows from it: fields of the state or a part of it,
    by name. Panels write nothing themselves."""
    for name, value in values.items():
        getattr(part, name)  # AttributeError where it has none
        setattr(part, name, value)


def set_display(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Choose what is shown; `latent_level` is an index into `scene.LEVELS`."""
    state = viewer.state
    if not _can_show(viewer, DISPLAYS[display].needs_field):
        return
    latent_level = state.latent_level if latent_level is None else latent_level
    if (display, latent_level) != (state.picture.display, state.latent_level):
        remember(viewer)
    state.picture, state.latent_level = replace(state.picture, display=display), latent_level


def set_picture(viewer: Viewer, picture: PictureConfig) -> None:
    """Take other settings of the image, as its sliders give them."""
    before = viewer.state.picture
    if picture != before:
        names = (field.name for field in fields(picture))
        remember(viewer, " ".join(name for name in names if getattr(picture, name) != getattr(before, name)))
        viewer.state.picture = picture


def set_theme(viewer: Viewer, theme: Theme) -> None:
    viewer.state.preferences = replace(viewer.state.preferences, theme=theme)


def set_ui_scale(viewer: Viewer, scale: float) -> None:
    """Set how large letters and widgets are, within `preferences.SCALES`."""
    low, high = SCALES
    viewer.state.preferences = replace(viewer.state.preferences, ui_scale=min(max(scale, low), high))


def resize(viewer: Viewer, width: int, height: int) -> None:
    """The scene's area of the window, pixels."""
    viewer.state.size = (max(1, width), max(1, height))


def toggle_panel(viewer: Viewer) -> None:
    viewer.state.show_panel = not viewer.state.show_panel


def open_panel(viewer: Viewer, title: str) -> None:
    """Have a panel opened, in front of those it shares its place with."""
    viewer.state.show_panel, viewer.state.wanted_panel = True, title


def reset_panels(viewer: Viewer) -> None:
    viewer.state.show_panel = viewer.state.resets_panels = True


def take_panel_reset(viewer: Viewer) -> bool:
    """Return whether the panels go back to their first places now; True once."""
    reset, viewer.state.resets_panels = viewer.state.resets_panels, False
    return reset


def take_wanted_panel(viewer: Viewer) -> str:
    """Return the title of the panel that is opened now, "" for none; once."""
    title, viewer.state.wanted_panel = viewer.state.wanted_panel, ""
    return title


def note_panels(viewer: Viewer, titles: tuple[str, ...]) -> None:
    state = viewer.state
    if titles != state.preferences.panels:
        state.preferences = replace(state.preferences, panels=titles)


def toggle_help(viewer: Viewer) -> None:
    viewer.state.show_help = not viewer.state.show_help


def show_palette(viewer: Viewer, shown: bool) -> None:
    """Set whether the list of everything that can be done is there, its box empty."""
    viewer.state.show_palette, viewer.state.palette_typed = shown, ""
    viewer.state.awaits_keyboard |= shown


def toggle_palette(viewer: Viewer) -> None:
    show_palette(viewer, not viewer.state.show_palette)


def escape(viewer: Viewer) -> None:
    """Close what lies over the scene, and let letters be keys again; where nothing did, leave the tool."""
    state = viewer.state
    lay_over = state.show_help or state.show_palette or state.browser or state.selection.leaving
    state.show_help = False
    show_palette(viewer, False)
    measure(viewer, False)
    state.pins_notes = False
    state.browser = None
    stay(viewer)
    viewer.state.letters_muted = False
    if not lay_over:
        leave_tool(viewer)
