# ruff: noqa: F401
"""What the viewer can do: the functions that buttons, keys, dropped files and tests call.

Each takes the `Viewer` and changes its state; long work goes to the worker. None of them raises for
something a user did: the reason appears in the messages area.
"""

from langsplat_viewer.actions.filming import (
    add_keyframe,
    choose_keyframe,
    clear_path,
    delete_keyframe,
    load_path,
    load_typed_path,
    move_keyframe,
    replace_keyframe,
    save_path,
    set_looping,
    set_path_seconds,
    set_turning,
    type_path_file,
)
from langsplat_viewer.actions.filming import cancel_film as cancel_film
from langsplat_viewer.actions.filming import copy_command as copy_command
from langsplat_viewer.actions.filming import save_film as save_film
from langsplat_viewer.actions.filming import save_sized_picture as save_sized_picture
from langsplat_viewer.actions.filming import set_film_fps as set_film_fps
from langsplat_viewer.actions.filming import set_film_size as set_film_size
from langsplat_viewer.actions.filming import take_clipboard as take_clipboard
from langsplat_viewer.actions.filming import type_film as type_film
from langsplat_viewer.actions.opening import (
    add_scenes,
    ask_for_file,
    ask_for_photographs,
    browse,
    choose,
    choose_photograph_folder,
    close_browser,
    fade_photograph,
    fetch_photograph,
    keep_old,
    open_all,
    open_dropped,
    open_recent,
    open_scenes,
    open_typed,
    photograph_here,
    reload,
    step_scene,
    switch_scene,
    type_path,
    unlist_scene,
)
from langsplat_viewer.actions.opening import cancel as cancel
from langsplat_viewer.actions.opening import choose_photographs as choose_photographs
from langsplat_viewer.actions.opening import open_scene as open_scene
from langsplat_viewer.actions.queries import ask as ask
from langsplat_viewer.actions.queries import (
    ask_offered,
    load_queries,
    offers,
    prepare_suggestions,
    recall,
    save_queries,
    set_canonical,
    set_cut,
    type_canonical,
)
from langsplat_viewer.actions.queries import ask_typed as ask_typed
from langsplat_viewer.actions.queries import focus_search as focus_search
from langsplat_viewer.actions.queries import hide as hide
from langsplat_viewer.actions.queries import remove as remove
from langsplat_viewer.actions.queries import select as select
from langsplat_viewer.actions.queries import set_level as set_level
from langsplat_viewer.actions.queries import show as show
from langsplat_viewer.actions.queries import take_search_focus as take_search_focus
from langsplat_viewer.actions.queries import type_phrase as type_phrase
from langsplat_viewer.actions.selecting import (
    begin_stroke,
    cancel_stroke,
    discard_and_leave,
    drawn_stroke,
    end_stroke,
    export,
    extend_stroke,
    finish_writing,
    leave_tool,
    may_close,
    quit_viewer,
    save_and_leave,
    stay,
)
from langsplat_viewer.actions.selecting import chosen_query as chosen_query
from langsplat_viewer.actions.selecting import delete_selected as delete_selected
from langsplat_viewer.actions.selecting import find_things as find_things
from langsplat_viewer.actions.selecting import grow_selection as grow_selection
from langsplat_viewer.actions.selecting import hide_selected as hide_selected
from langsplat_viewer.actions.selecting import invert_selection as invert_selection
from langsplat_viewer.actions.selecting import isolate_selected as isolate_selected
from langsplat_viewer.actions.selecting import reach as reach
from langsplat_viewer.actions.selecting import select_all as select_all
from langsplat_viewer.actions.selecting import select_none as select_none
from langsplat_viewer.actions.selecting import select_query as select_query
from langsplat_viewer.actions.selecting import select_thing as select_thing
from langsplat_viewer.actions.selecting import set_brush as set_brush
from langsplat_viewer.actions.selecting import set_mode as set_mode
from langsplat_viewer.actions.selecting import set_only_visible as set_only_visible
from langsplat_viewer.actions.selecting import set_reach as set_reach
from langsplat_viewer.actions.selecting import show_hidden as show_hidden
from langsplat_viewer.actions.selecting import shrink_selection as shrink_selection
from langsplat_viewer.actions.selecting import use_tool as use_tool
from langsplat_viewer.actions.settings import (
    compare_with,
    measure,
    measure_at,
    move_line,
    save_transparent,
    set_clip,
    set_colour_map,
    set_splats,
    show_one,
    show_overlay,
    toggle_levels,
    toggle_measuring,
    toggle_overlay,
    toggle_wipe,
    turn_to_face,
)
from langsplat_viewer.actions.settings import escape as escape
from langsplat_viewer.actions.settings import mute_letters as mute_letters
from langsplat_viewer.actions.settings import note_panels as note_panels
from langsplat_viewer.actions.settings import open_panel as open_panel
from langsplat_viewer.actions.settings import resize as resize
from langsplat_viewer.actions.settings import set_coarse_while_moving as set_coarse_while_moving
from langsplat_viewer.actions.settings import set_display as set_display
from langsplat_viewer.actions.settings import set_picture as set_picture
from langsplat_viewer.actions.settings import set_theme as set_theme
from langsplat_viewer.actions.settings import set_ui_scale as set_ui_scale
from langsplat_viewer.actions.settings import show_help as show_help
from langsplat_viewer.actions.settings import show_palette as show_palette
from langsplat_viewer.actions.settings import show_panel as show_panel
from langsplat_viewer.actions.settings import take_wanted_panel as take_wanted_panel
from langsplat_viewer.actions.settings import toggle_help as toggle_help
from langsplat_viewer.actions.settings import toggle_panel as toggle_panel
from langsplat_viewer.actions.settings import type_command as type_command
from langsplat_viewer.actions.training import (
    fill_in,
    look_at_training,
    start_training,
    stop_training,
    watch_training,
)
from langsplat_viewer.actions.undoing import redo as redo
from langsplat_viewer.actions.undoing import undo as undo
from langsplat_viewer.actions.viewpoint import (
    add_bookmark,
    compare_with_reference,
    delete_bookmark,
    focus_pixel,
    focus_result,
    frame_scene,
    glide_to,
    go_to_bookmark,
    go_to_camera,
    hover,
    look_from,
    measure_frame,
    move,
    open_at,
    open_orthographic,
    path_seconds,
    reset_view,
    scrub,
    set_fly_speed,
    set_orthographic,
    set_walking,
    step_camera,
    stop_comparing,
    tick,
    toggle_orthographic,
    toggle_playing,
    toggle_pointing,
    toggle_walking,
    type_bookmark,
    zoom_by,
)
