"""What the viewer can do: the functions that buttons, keys, dropped files and tests call.

Each takes the `Viewer` and changes its state; long work goes to the worker. None of them raises for
something a user did: the reason appears in the messages area.
"""

from langsplat_viewer.actions.camera import (
    focus_pixel,
    focus_result,
    glide_to,
    go_to_camera,
    move,
    reset_view,
    set_fly_speed,
    stand_at,
    step_camera,
    tick,
)
from langsplat_viewer.actions.offers import ask_offered, offers, prepare_suggestions, recall
from langsplat_viewer.actions.opening import cancel, open_scene, open_typed, type_path
from langsplat_viewer.actions.queries import (
    ask,
    ask_typed,
    focus_search,
    hide,
    remove,
    set_level,
    show,
    take_search_focus,
    type_phrase,
)
from langsplat_viewer.actions.settings import (
    resize,
    set_coarse_while_moving,
    set_display,
    set_picture,
    show_help,
    show_panel,
    toggle_help,
    toggle_panel,
)

__all__ = [
    "ask",
    "ask_offered",
    "ask_typed",
    "cancel",
    "focus_pixel",
    "focus_result",
    "focus_search",
    "glide_to",
    "go_to_camera",
    "hide",
    "move",
    "offers",
    "open_scene",
    "open_typed",
    "prepare_suggestions",
    "recall",
    "remove",
    "reset_view",
    "resize",
    "set_coarse_while_moving",
    "set_display",
    "set_fly_speed",
    "set_level",
    "set_picture",
    "show",
    "show_help",
    "show_panel",
    "stand_at",
    "step_camera",
    "take_search_focus",
    "tick",
    "toggle_help",
    "toggle_panel",
    "type_path",
    "type_phrase",
]
