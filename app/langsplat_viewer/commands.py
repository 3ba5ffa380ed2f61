"""Everything that can be done with one key or one click: one table, from which the menus, the keys, the list
of keys and the list of commands are made."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from langsplat_core.config import Display
from langsplat_core.display.displays import DISPLAYS, DisplayRow
from langsplat_core.scene import LEVELS
from langsplat_viewer.actions import (
    browsing,
    editing,
    filming,
    opening,
    projects,
    queries,
    selecting,
    settings,
    viewpoint,
)
from langsplat_viewer.actions.selecting import Part
from langsplat_viewer.camera.controls import Side, adopt_up, level
from langsplat_viewer.files.preferences import THEMES, Theme
from langsplat_viewer.marks import TOOLS, Tool
from langsplat_viewer.state import Overlay
from langsplat_viewer.viewer import Viewer


@dataclass(frozen=True)
class Button:
    """One way to look at the scene."""

    label: str  # of a radio button, with imgui's suffix where another has the same
    display: Display
    latent_level: int | None = None  # index into LEVELS


def buttons_of(row: DisplayRow) -> tuple[Button, ...]:
    """One for the display, but for each level one where it shows latents."""
    if not row.by_level:
        return (Button(row.label, row.name),)
    return tuple(Button(f"{name}##{row.name}", row.name, index) for index, name in enumerate(LEVELS))


BUTTONS = tuple(button for row in DISPLAYS.values() for button in buttons_of(row))


@dataclass(frozen=True)
class Command:
    """One row: what it does, in words, and the keys for it.

    Keys are written as people read them: "Ctrl+Shift+P", "F1", "R", or a typed character such as "?",
    wherever that is on the keyboard. Those with Ctrl, and F1, also work while something is typed;
    others never do, nor with Ctrl held.
    """

    does: str
    act: Callable[[Viewer], object]
    keys: tuple[str, ...] = ()
    menu: str = ""  # one of MENUS; without one it is found in the list of commands alone
    repeats: bool = False  # while held
    is_edit: bool = False  # belongs to the box while one types, as it does everywhere
    is_on: Callable[[Viewer], bool] | None = None  # for a check mark in the menu
    apart: bool = False  # a line is above it in the menu
    icon: str = ""  # on the toolbar, a name of Font Awesome 6 without its "ICON_FA_"


def _show(button: Button) -> Callable[[Viewer], None]:
    return lambda viewer: settings.set_display(viewer, button.display, button.latent_level)


def _name(button: Button) -> str:
    name = button.label.partition("##")[0]
    return (
        f"show {DISPLAYS[button.display].label.lower()}{'' if button.latent_level is None else ', ' + name}"
    )


def _is_shown(button: Button) -> Callable[[Viewer], bool]:
    def shown(viewer: Viewer) -> bool:
        state, level = viewer.state, button.latent_level
        return state.picture.display == button.display and level in (None, state.latent_level)

    return shown


def _theme(theme: Theme) -> Command:
    return Command(
        f"{theme} theme",
        lambda viewer: settings.set_theme(viewer, theme),
        menu="Window",
        is_on=lambda viewer: viewer.state.preferences.theme == theme,
    )


def _letters(scale: float) -> Command:
    return Command(
        f"letters of {100 * scale:.0f} %",
        lambda viewer: settings.set_ui_scale(viewer, scale),
        menu=LETTERS_MENU,
        is_on=lambda viewer: abs(viewer.state.preferences.ui_scale - scale) < 1e-6,
    )


def _recent(path: str) -> Command:
    name = Path(path)
    return Command(f"open {name.parent.name}/{name.name}", lambda viewer: browsing.open_recent(viewer, path))


def _panel(title: str) -> Command:
    return Command(f"panel: {title}", lambda viewer: settings.open_panel(viewer, title))


def _overlay(name: Overlay, title: str) -> Command:
    keys = ("B",) if name == "things" else ()
    return Command(
        f"show or hide the {title}",
        lambda viewer: settings.toggle_overlay(viewer, name),
        keys,
        "View",
        is_on=lambda viewer: name in viewer.state.preferences.overlays,
    )


OVERLAY_TITLES: dict[Overlay, str] = {
    "things": "boxes of what was found",
    "cameras": "training cameras",
    "cube": "view cube",
    "grid": "ground grid",
}


def _tool(tool: Tool) -> Command:
    return Command(
        f"select: {tool}",
        lambda viewer: selecting.use_tool(viewer, tool),
        menu="Select",
        is_on=lambda viewer: viewer.state.selection.tool == tool,
        icon=TOOL_ICONS[tool],
    )


def _export(does: str, part: Part, as_points: bool = False) -> Command:
    return Command(
        does, lambda viewer: selecting.export(viewer, Path.cwd(), part, as_points=as_points), menu="Select"
    )


def _side(side: Side, key: str) -> Command:
    where = {"top": "above", "bottom": "below"}.get(side, f"the {side}")
    return Command(f"look from {where}", lambda viewer: viewpoint.look_from(viewer, side), (key,), "Camera")


SIDE_KEYS: tuple[tuple[Side, str], ...] = (
    ("front", "Keypad1"),
    ("back", "Ctrl+Keypad1"),
    ("right", "Keypad3"),
    ("left", "Ctrl+Keypad3"),
    ("top", "Keypad7"),
    ("bottom", "Ctrl+Keypad7"),
)
PANEL_TITLES = (
    *("Search", "Display", "Camera", "Scene", "Outline", "Select", "Transform"),
    *("Library", "Train", "Record", "Bookmarks", "Messages", "Overlays", "Notes", "Timing"),
)
LETTERS_MENU = "Size of letters"  # in the menu Window
TOOL_ICONS: dict[Tool, str] = {
    "thing": "HAND_POINTER",
    "rectangle": "VECTOR_SQUARE",
    "lasso": "DRAW_POLYGON",
    "brush": "BRUSH",
    "sphere": "CIRCLE",
    "box": "CUBE",
}
DISPLAY_ICONS: dict[Display, str] = {
    "rgb": "IMAGE",
    "relevancy": "FIRE",
    "segmentation": "HIGHLIGHTER",
    "latent": "PALETTE",
    "tree": "SITEMAP",
    "depth": "MOUNTAIN",
}
UI_SCALES = (0.75, 1.0, 1.25, 1.5, 2.0, 2.5, 3.0)
MENUS = ("File", "Edit", "Select", "View", "Camera", "Window", "Help")

COMMANDS: tuple[Command, ...] = (
    Command("open a scene", browsing.ask_for_file, ("Ctrl+O",), "File"),
    Command(
        "search all scenes of a folder",
        lambda viewer: browsing.ask_for_folder(viewer, "library"),
        menu="File",
    ),
    Command("reload the scene", opening.reload, ("F5",), "File", apart=True),
    Command(
        "next scene of the list", lambda viewer: opening.step_scene(viewer, 1), ("Ctrl+PageDown",), "File"
    ),
    Command(
        "previous scene of the list", lambda viewer: opening.step_scene(viewer, -1), ("Ctrl+PageUp",), "File"
    ),
    Command("train a scene", lambda viewer: settings.open_panel(viewer, "Train"), menu="File", apart=True),
    Command(
        "save a picture",
        filming.save_picture,
        ("Ctrl+S", "P"),
        "File",
        icon="CAMERA",
        apart=True,
    ),
    Command("save the view", filming.save_view, menu="File"),
    Command(
        "save the project",
        projects.save_project,
        ("Ctrl+Shift+S",),
        "File",
    ),
    Command("save the queries", queries.save_queries, menu="File"),
    Command(
        "copy the command of this picture",
        filming.copy_command,
        ("Ctrl+Shift+C",),
        "File",
    ),
    Command(
        "save a picture of the size of the film",
        filming.save_sized_picture,
        menu="File",
    ),
    Command("save a film of the path", filming.save_film, menu="File"),
    Command("save the camera path", filming.save_path, menu="File"),
    Command("quit", selecting.quit_viewer, ("Ctrl+Q",), "File", apart=True),
    Command("search", queries.focus_search, ("Ctrl+F", "/"), "Edit"),
    Command("remove all queries", queries.remove_all, menu="Edit"),
    Command("undo", editing.undo, ("Ctrl+Z",), "Edit", repeats=True, is_edit=True, apart=True),
    Command("redo", editing.redo, ("Ctrl+Shift+Z", "Ctrl+Y"), "Edit", repeats=True, is_edit=True),
    Command(
        "gizmo: move, rotate, scale, off",
        editing.next_gizmo,
        ("G",),
        "Edit",
        is_on=lambda viewer: viewer.state.edit_form.gizmo != "off",
        icon="UP_DOWN_LEFT_RIGHT",
        apart=True,
    ),
    Command("select everything", selecting.select_all, ("Ctrl+A",), "Select", is_edit=True),
    Command("select nothing", selecting.select_none, ("Ctrl+D", "Ctrl+Shift+A"), "Select", is_edit=True),
    Command("invert the selection", selecting.invert_selection, ("Ctrl+I",), "Select", is_edit=True),
    Command("select what the search found", selecting.select_query, menu="Select", apart=True),
    Command("select everything like the selection", selecting.select_alike, menu="Select"),
    Command("grow the selection", selecting.grow_selection, menu="Select"),
    Command("shrink the selection", selecting.shrink_selection, menu="Select"),
    Command(
        "select with no tool: the left button turns the view",
        selecting.leave_tool,
        menu="Select",
        is_on=lambda viewer: viewer.state.selection.tool is None,
        icon="HAND",
        apart=True,
    ),
    *(_tool(tool) for tool in TOOLS),
    Command("hide the selection", selecting.hide_selected, ("H",), "Select", apart=True),
    Command("isolate the selection", selecting.isolate_selected, ("Shift+H",), "Select"),
    Command("show all that is hidden", selecting.show_hidden, ("U", "Alt+H"), "Select"),
    Command("delete the selection", selecting.delete_selected, ("Delete",), "Select"),
    _export("save the selection", "selection"),
    _export("save the selection as points", "selection", as_points=True),
    _export("save the rest", "rest"),
    _export("save the scene without what was deleted", "edited"),
    *(
        Command(
            _name(button),
            _show(button),
            (str(key),) if key < 10 else (),
            "View",
            is_on=_is_shown(button),
            icon="" if button.latent_level in (0, 1) else DISPLAY_ICONS.get(button.display, ""),
        )
        for key, button in enumerate(BUTTONS, 1)
    ),
    Command(
        "say what is under the cursor",
        viewpoint.toggle_pointing,
        ("I",),
        "View",
        is_on=lambda viewer: viewer.state.pointing,
        icon="COMMENT_DOTS",
        apart=True,
    ),
    Command(
        "compare two displays",
        settings.toggle_wipe,
        ("V",),
        "View",
        is_on=lambda viewer: viewer.state.settings.split.mode == "wipe",
        icon="TABLE_COLUMNS",
    ),
    Command(
        "three levels side by side",
        settings.toggle_levels,
        menu="View",
        is_on=lambda viewer: viewer.state.settings.split.mode == "levels",
        icon="LAYER_GROUP",
    ),
    Command("compare with another scene", browsing.ask_for_beside, menu="View"),
    *(_overlay(name, title) for name, title in OVERLAY_TITLES.items()),
    Command(
        "compare the picture with the reference", viewpoint.compare_with_reference, menu="View", apart=True
    ),
    Command(
        "measure a distance",
        settings.toggle_measuring,
        ("M",),
        "View",
        is_on=lambda viewer: viewer.state.ruler.measures,
        icon="RULER",
    ),
    Command(
        "pin a note to what is clicked",
        projects.toggle_pinning,
        ("N",),
        "View",
        is_on=lambda viewer: viewer.state.pins_notes,
        icon="NOTE_STICKY",
    ),
    Command("pin a note to the selection", projects.pin_to_selection, menu="View"),
    Command("return to the opening view", viewpoint.reset_view, ("R", "Home"), "Camera", icon="HOUSE"),
    Command("frame everything", viewpoint.frame_scene, ("Shift+F",), "Camera", icon="EXPAND"),
    Command("focus on the latest result found", viewpoint.focus_result, ("F",), "Camera", icon="CROSSHAIRS"),
    Command(
        "previous training camera",
        lambda viewer: viewpoint.step_camera(viewer, -1),
        (",",),
        "Camera",
        True,
        apart=True,
    ),
    Command("next training camera", lambda viewer: viewpoint.step_camera(viewer, 1), (".",), "Camera", True),
    Command("level the horizon", lambda viewer: viewpoint.move(viewer, level), menu="Camera", apart=True),
    Command(
        "take the picture's up as the world's", lambda viewer: viewpoint.move(viewer, adopt_up), menu="Camera"
    ),
    *(_side(side, key) for side, key in SIDE_KEYS),
    Command(
        "orthographic view, and back", viewpoint.toggle_orthographic, ("O", "Keypad5"), "Camera", apart=True
    ),
    Command(
        "walk in place of flying, and back",
        viewpoint.toggle_walking,
        menu="Camera",
        is_on=lambda viewer: viewer.state.walks,
    ),
    Command("bookmark this view", viewpoint.add_bookmark, ("Ctrl+B",), "Camera", apart=True),
    Command("add a keyframe here", filming.add_keyframe, ("K",), "Camera"),
    Command("play the camera path, or stop", viewpoint.toggle_playing, ("Shift+K",), "Camera"),
    Command("hide or show the panels", settings.toggle_panel, ("F11",), "Window"),
    Command("panels as at first", settings.reset_panels, menu="Window", apart=True),
    *(_theme(theme) for theme in THEMES),
    *(_letters(scale) for scale in UI_SCALES),
    *(_panel(title) for title in PANEL_TITLES),
    Command("find a command", settings.toggle_palette, ("Ctrl+Shift+P",), "Help"),
    Command("first steps, and list of keys", settings.toggle_help, ("F1", "?"), "Help"),
    Command("close what lies over the scene", settings.escape, ("Esc",)),
)

# What the mouse does and what keys do for as long as they are held (`panels.navigation`), for people to read.
HELD: tuple[tuple[str, str], ...] = (
    ("left drag", "turn around the centre"),
    ("right drag, Shift + left drag", "move sideways"),
    ("Ctrl + left drag", "look around from here"),
    ("wheel", "nearer, farther"),
    ("left drag with a tool", "select; the middle button turns"),
    ("double click", "turn around the surface under the cursor"),
    ("W A S D, Q E", "fly ahead, left, back, right, down, up"),
    ("Shift, Alt", "fly faster, slower"),
    ("[ ]", "roll"),
    ("Tab, arrows, Enter", "travel in a panel; the box of the search completes by Tab, recalls by arrow up"),
    ("Ctrl + Tab", "to the next panel, the strip of icons, or the menus"),
    ("Menu, Shift + F10", "what can be done with a row of the outline"),
)


def with_key(text: str, act: Callable[[Viewer], object]) -> str:
    """`text`, and in brackets the key of the command that does it."""
    keys = next((command.keys for command in COMMANDS if command.act is act), ())
    return f"{text} ({keys[0]})" if keys else text


def matching(text: str, recent: Sequence[str] = ()) -> list[Command]:
    """The commands whose words hold every word of `text`; all of them for none. `recent` scenes are some."""
    words, commands = text.lower().split(), (*COMMANDS, *map(_recent, recent))
    return [command for command in commands if all(word in command.does.lower() for word in words)]


def in_menu(menu: str) -> list[Command]:
    """The commands of one of MENUS, in their order."""
    return [command for command in COMMANDS if command.menu == menu]
