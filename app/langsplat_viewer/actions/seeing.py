"""Several pictures side by side."""

from dataclasses import replace

from langsplat_core.config import Display
from langsplat_core.display.displays import DISPLAYS
from langsplat_core.query.engine import no_field
from langsplat_viewer.seeing import AT_RANGE, Split
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
    _set_split(viewer, replace(viewer.state.seeing.split, at=min(max(at, low), high)))


def _can_show(viewer: Viewer, needs_field: bool) -> bool:
    """Whether the scene has a language field where one is needed; says so where it has none."""
    scene = viewer.state.scene
    if needs_field and scene is not None and scene.language is None:
        viewer.state.say(no_field(scene), is_error=True)
        return False
    return True


def _set_split(viewer: Viewer, split: Split) -> None:
    viewer.state.seeing = replace(viewer.state.seeing, split=split)
