"""What is shown and how; which parts of the window are."""

from dataclasses import replace

from langsplat_core.config import Display, PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.engine import no_field
from langsplat_viewer.viewer import Viewer


def set_display(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Choose what is shown; `latent_level` is an index into `scene.LEVELS`."""
    state = viewer.state
    if DISPLAYS[display].needs_field and state.scene is not None and state.scene.language is None:
        state.say(no_field(state.scene), is_error=True)
        return
    state.picture = replace(state.picture, display=display)
    if latent_level is not None:
        state.latent_level = latent_level


def set_picture(viewer: Viewer, picture: PictureConfig) -> None:
    """Take other settings of the picture, as its sliders give them."""
    viewer.state.picture = picture


def set_coarse_while_moving(viewer: Viewer, coarse: bool) -> None:
    """Whether a slow machine draws fewer pixels while the camera moves."""
    viewer.state.coarse_while_moving = coarse


def resize(viewer: Viewer, width: int, height: int) -> None:
    """The scene's area of the window, pixels."""
    viewer.state.size = (max(1, width), max(1, height))


def show_panel(viewer: Viewer, shown: bool) -> None:
    """Whether the column of panels is there."""
    viewer.state.show_panel = shown


def toggle_panel(viewer: Viewer) -> None:
    """Hide the column of panels, or show it again."""
    show_panel(viewer, not viewer.state.show_panel)


def show_help(viewer: Viewer, shown: bool) -> None:
    """Whether the list of keys is there."""
    viewer.state.show_help = shown


def toggle_help(viewer: Viewer) -> None:
    """Show the list of keys, or hide it again."""
    show_help(viewer, not viewer.state.show_help)
