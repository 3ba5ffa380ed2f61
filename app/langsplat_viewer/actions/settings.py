"""What is shown and how; which parts of the window are."""

from dataclasses import fields, replace

from langsplat_core.config import Display, PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.engine import no_field
from langsplat_viewer.actions.history import remember
from langsplat_viewer.actions.leaving import stay
from langsplat_viewer.actions.seeing import measure
from langsplat_viewer.actions.strokes import leave_tool
from langsplat_viewer.files.preferences import SCALES, Theme
from langsplat_viewer.keys import Keying
from langsplat_viewer.viewer import Viewer


def set_display(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Choose what is shown; `latent_level` is an index into `scene.LEVELS`."""
    state = viewer.state
    if DISPLAYS[display].needs_field and state.scene is not None and state.scene.language is None:
        state.say(no_field(state.scene), is_error=True)
        return
    latent_level = state.latent_level if latent_level is None else latent_level
    if (display, latent_level) != (state.picture.display, state.latent_level):
        remember(viewer)
    state.picture, state.latent_level = replace(state.picture, display=display), latent_level


def set_picture(viewer: Viewer, picture: PictureConfig) -> None:
    """Take other settings of the picture, as its sliders give them."""
    before = viewer.state.picture
    if picture != before:
        names = (field.name for field in fields(picture))
        remember(viewer, " ".join(name for name in names if getattr(picture, name) != getattr(before, name)))
        viewer.state.picture = picture


def set_coarse_while_moving(viewer: Viewer, coarse: bool) -> None:
    """Whether a slow machine draws fewer pixels while the camera moves."""
    viewer.state.coarse_while_moving = coarse


def set_theme(viewer: Viewer, theme: Theme) -> None:
    """Dark or light panels, from now on."""
    viewer.state.preferences = replace(viewer.state.preferences, theme=theme)


def set_ui_scale(viewer: Viewer, scale: float) -> None:
    """How large letters and widgets are, within `preferences.SCALES`."""
    low, high = SCALES
    viewer.state.preferences = replace(viewer.state.preferences, ui_scale=min(max(scale, low), high))


def resize(viewer: Viewer, width: int, height: int) -> None:
    """The scene's area of the window, pixels."""
    viewer.state.size = (max(1, width), max(1, height))


def show_panel(viewer: Viewer, shown: bool) -> None:
    """Whether the panels are there."""
    viewer.state.show_panel = shown


def toggle_panel(viewer: Viewer) -> None:
    """Hide the panels, or show them again."""
    show_panel(viewer, not viewer.state.show_panel)


def open_panel(viewer: Viewer, title: str) -> None:
    """Have a panel opened, in front of those it shares its place with."""
    show_panel(viewer, True)
    viewer.state.wanted_panel = title


def take_wanted_panel(viewer: Viewer) -> str:
    """The panel that is opened now, "" for none; said once."""
    title, viewer.state.wanted_panel = viewer.state.wanted_panel, ""
    return title


def note_panels(viewer: Viewer, titles: tuple[str, ...]) -> None:
    """Remember which panels are open."""
    state = viewer.state
    if titles != state.preferences.panels:
        state.preferences = replace(state.preferences, panels=titles)


def show_help(viewer: Viewer, shown: bool) -> None:
    """Whether the list of keys is there; it is only read at first."""
    if shown != viewer.state.show_help:
        viewer.state.show_help, viewer.state.keying = shown, Keying()


def toggle_help(viewer: Viewer) -> None:
    """Show the list of keys, or hide it again."""
    show_help(viewer, not viewer.state.show_help)


def edit_keys(viewer: Viewer, edits: bool) -> None:
    """Whether the list of keys is there to change them."""
    show_help(viewer, True)
    viewer.state.keying = Keying(edits)


def type_keys(viewer: Viewer, text: str) -> None:
    """What stands in the box of that list."""
    viewer.state.keying = replace(viewer.state.keying, typed=text)


def show_palette(viewer: Viewer, shown: bool) -> None:
    """Whether the list of everything that can be done is there, its box empty."""
    viewer.state.show_palette, viewer.state.palette_typed = shown, ""


def type_command(viewer: Viewer, text: str) -> None:
    """What stands in the box of that list."""
    viewer.state.palette_typed = text


def mute_letters(viewer: Viewer, muted: bool) -> None:
    """Whether letters do nothing for now: they were meant for a box that cannot be typed in."""
    viewer.state.letters_muted = muted


def escape(viewer: Viewer) -> None:
    """Close what lies over the scene, and let letters be keys again; where nothing did, leave the tool."""
    state = viewer.state
    lay_over = state.show_help or state.show_palette or state.browser or state.selection.leaving
    show_help(viewer, False)
    show_palette(viewer, False)
    measure(viewer, False)
    state.browser = None
    stay(viewer)
    mute_letters(viewer, False)
    if not lay_over:
        leave_tool(viewer)
