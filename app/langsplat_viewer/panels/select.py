"""The panel to select with: tools, what to do with what they find, and what becomes of it."""

from collections.abc import Callable, Sequence
from pathlib import Path

from imgui_bundle import hello_imgui, imgui

from langsplat_viewer import actions
from langsplat_viewer.commands import with_key
from langsplat_viewer.marks import BRUSHES, MODES, REACHES, TOOLS, Marks
from langsplat_viewer.panels.style import (
    beside,
    beside_boxed,
    elided,
    leave_room,
    muted,
    small_wrapped,
    tip,
    width_of,
)
from langsplat_viewer.viewer import Viewer

MOST_THINGS = 24  # of an answer that have a button
Verb = tuple[str, Callable[[Viewer], object], str]  # button, action, tip
CHANGES: tuple[Verb, ...] = (
    ("All", actions.select_all, "Everything that is shown"),
    ("None", actions.select_none, "Nothing"),
    ("Invert", actions.invert_selection, "What was not selected"),
    ("Grow", actions.grow_selection, "And what is within reach along the surface"),
    ("Shrink", actions.shrink_selection, "Without what is within reach of the rest"),
)
FATES: tuple[Verb, ...] = (
    ("Hide", actions.hide_selected, "Out of the picture"),
    ("Isolate", actions.isolate_selected, "Everything else out of the picture"),
    ("Show all", actions.show_hidden, "Everything that was hidden"),
    (
        "Delete",
        actions.delete_selected,
        "Out of the scene; its file stays as it is",
    ),
)
FILES: tuple[Verb, ...] = (
    ("Selection", lambda viewer: actions.export(viewer, Path.cwd(), "selection"), "A PLY with its field"),
    ("Rest", lambda viewer: actions.export(viewer, Path.cwd(), "rest"), "Everything else as a PLY"),
    (
        "Points",
        lambda viewer: actions.export(viewer, Path.cwd(), "selection", as_points=True),
        "The selection as a point cloud",
    ),
    (
        "Scene",
        lambda viewer: actions.export(viewer, Path.cwd(), "edited"),
        "The scene without what was deleted, as a new PLY",
    ),
)


def draw(viewer: Viewer) -> None:
    """Counts, tools, the search, verbs, files."""
    imgui.begin_disabled(viewer.state.scene is None)
    small_wrapped(counts(viewer.state.selection.marks), muted())
    _tools(viewer)
    _found(viewer)
    imgui.separator()
    _buttons(viewer, CHANGES)
    actions.set_reach(viewer, _slider("Reach", viewer.state.selection.reach, REACHES, "%.3f of the scene"))
    imgui.separator()
    _buttons(viewer, FATES)
    imgui.separator()
    imgui.align_text_to_frame_padding()
    imgui.text("Save")
    imgui.same_line()
    _buttons(viewer, FILES)
    imgui.end_disabled()


def counts(marks: Marks) -> str:
    """How many are marked, in words."""
    selected, hidden, deleted = (int(part.sum()) for part in (marks.selected, marks.hidden, marks.deleted))
    return f"{selected:,} of {len(marks.selected):,} selected, {hidden:,} hidden, {deleted:,} deleted"


def _tools(viewer: Viewer) -> None:
    selection = viewer.state.selection
    for place, tool in enumerate(TOOLS):
        active = selection.tool == tool
        if place:
            beside(tool)
        colour = imgui.Col_.button_active if active else imgui.Col_.button
        imgui.push_style_color(imgui.Col_.button, imgui.get_style_color_vec4(colour))
        if imgui.button(f"{tool.capitalize()}##tool"):
            actions.use_tool(viewer, None if active else tool)
        imgui.pop_style_color()
    for place, mode in enumerate(MODES):
        if place:
            beside_boxed(mode)
        if imgui.radio_button(mode.capitalize(), selection.mode == mode):
            actions.set_mode(viewer, mode)
    _, only = imgui.checkbox("Only what is visible", selection.only_visible)
    actions.set_only_visible(viewer, only)
    tip("Rectangle, lasso and brush leave out what lies behind something")
    if selection.tool == "brush":
        actions.set_brush(viewer, _slider("Brush", selection.brush, BRUSHES, "%.3f of the height"))


def _found(viewer: Viewer) -> None:
    """What the search found, whole or thing by thing."""
    query = actions.chosen_query(viewer)
    if query is None or query.result is None:
        return
    button = imgui.calc_text_size("Things").x + 2 * imgui.get_style().frame_padding.x
    room = imgui.get_content_region_avail().x - button - imgui.get_style().item_spacing.x
    name = elided(query.phrase, room - hello_imgui.em_size(4), width_of)
    if imgui.button(f"Found: {name}##found"):
        actions.select_query(viewer, query)
    tip("Select what the search has found")
    imgui.same_line()
    if imgui.button("Things"):
        actions.find_things(viewer, query)
    tip("Take it apart, to select one thing at a time")
    things = viewer.state.selection.things
    if things is None or things.result is not query.result:
        return
    for number, thing in enumerate(things.found[:MOST_THINGS]):
        if number:
            beside(str(number + 1))
        if imgui.button(f"{number + 1}##thing"):
            actions.select_thing(viewer, number)
        tip(f"{thing.count:,} Gaussians, {100 * thing.share:.0f} % of the answer, score {thing.score:.2f}")


def _buttons(viewer: Viewer, verbs: Sequence[Verb]) -> None:
    """As many in a row as fit."""
    for place, (name, act, what) in enumerate(verbs):
        if place:
            beside(name)
        if imgui.button(f"{name}##verb"):
            act(viewer)
        tip(with_key(what, act))


def _slider(label: str, value: float, limits: tuple[float, float], text: str) -> float:
    leave_room(label, 12)
    flags = imgui.SliderFlags_.always_clamp | imgui.SliderFlags_.logarithmic
    _, value = imgui.slider_float(label, value, *limits, text, flags)
    return value
