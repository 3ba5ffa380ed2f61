"""Everything that can be done with one key or one click, as one table.

The menus, the keys, the list of keys and the list of commands are made from it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from operator import attrgetter
from pathlib import Path

from langsplat_core.config import Display
from langsplat_core.display.displays import DISPLAYS, DisplayRow
from langsplat_core.scene import LEVELS
from langsplat_viewer.actions import editing, opening, queries, saving, settings, viewpoint
from langsplat_viewer.camera.controls import Side, adopt_up, level
from langsplat_viewer.marks import TOOLS, Tool
from langsplat_viewer.session import Overlay
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer


@dataclass(frozen=True)
class Button:
    """A button for a display, or for one level of it."""

    label: str  # of its button, with imgui's suffix where another has the same
    display: Display
    latent_level: int | None = None  # index into LEVELS

    @property
    def name(self) -> str:
        """Name of the display, and of its level where there are several."""
        label = DISPLAYS[self.display].label
        return label if self.latent_level is None else f"{label}, {LEVELS[self.latent_level]}"


def buttons_of(row: DisplayRow) -> tuple[Button, ...]:
    """Return a display's buttons: one, or one for each level where it has levels."""
    if not row.by_level:
        return (Button(row.label, row.name),)
    return tuple(
        Button(f"{name.capitalize()}##{row.name}", row.name, index) for index, name in enumerate(LEVELS)
    )


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
    button: str = ""  # its label in a panel
    icon: str = ""  # on the toolbar: a name of Font Awesome 6 without its "ICON_FA_"
    finds: str = ""  # other words that people look for
    repeats: bool = False  # while held
    is_edit: bool = False  # belongs to the box while one types, as it does everywhere
    is_on: Callable[[Viewer], bool] = lambda viewer: False  # for a check mark in the menu
    apart: bool = False  # a line is above it in the menu
    now: Callable[[Viewer], str] = lambda viewer: ""  # words for the menu in place of `does`


def is_shown(state: ViewerState, button: Button) -> bool:
    """Return whether the scene is shown in a button's display and level."""
    session = state.session
    return session.picture.display == button.display and button.latent_level in (None, session.latent_level)


def _is(path: str, *values: object) -> Callable[[Viewer], bool]:
    """Return the check that what `path` names in the state is one of the values; of none, that it is true."""
    of = attrgetter(path)
    return lambda v: of(v.state) in values if values else bool(of(v.state))


def _display(button: Button, number: int) -> Command:
    return Command(
        f"show {button.name.lower()}",
        lambda v: settings.set_display(v, button.display, button.latent_level),
        (str(number),) if number < 10 else (),
        icon=DISPLAY_ICONS.get(button.display, "") if button.latent_level in (None, WHOLE) else "",
        is_on=lambda v: is_shown(v.state, button),
    )


def _overlay(name: Overlay, title: str, *keys: str, finds: str = "") -> Command:
    return Command(
        f"show or hide the {title}",
        lambda v: settings.toggle_overlay(v, name),
        keys,
        finds=finds,
        is_on=lambda v: name in v.state.session.overlays,
    )


def _step(step: editing.Step, act: editing.Action, *keys: str, finds: str = "") -> Command:
    now = partial(editing.named_step, step=step)
    return Command(step, act, keys, finds=finds, repeats=True, is_edit=True, apart=step == "undo", now=now)


def _export_as(title: str) -> Command:
    act, now, row = partial(saving.ask_export, title=title), f"{title} ...", saving.EXPORTS[title]
    return Command(f"export: {now}", act, button=f"Export {now}", finds=row.finds, now=lambda viewer: now)


WHOLE = LEVELS.index("whole")
DISPLAY_ICONS: dict[Display, str] = {
    "rgb": "IMAGE", "relevancy": "FIRE", "segmentation": "HIGHLIGHTER", "latent": "PALETTE",
    "tree": "SITEMAP", "depth": "MOUNTAIN",
}  # fmt: skip
TOOL_ICONS: dict[Tool, str] = {
    "thing": "HAND_POINTER", "rectangle": "VECTOR_SQUARE", "lasso": "DRAW_POLYGON", "brush": "BRUSH",
    "sphere": "CIRCLE", "box": "CUBE",
}  # fmt: skip
SIDES: dict[Side, tuple[str, str]] = {  # words and key
    "front": ("the front", "Keypad1"), "back": ("the back", "Ctrl+Keypad1"),
    "right": ("the right", "Keypad3"), "left": ("the left", "Ctrl+Keypad3"),
    "top": ("above", "Keypad7"), "bottom": ("below", "Ctrl+Keypad7"),
}  # fmt: skip
open_train = partial(settings.open_panel, title="Train")
OTHER_THEME = {"dark": "light", "light": "dark"}

BY_MENU: dict[str, tuple[Command, ...]] = {
    "File": (
        Command("open a scene ...", opening.ask_for_file, ("Ctrl+O",), button="Open a scene ...",
                finds="load import file browse ply splat project"),
        Command("start page", settings.toggle_start, is_on=_is("show_start"),
                finds="home welcome recent close demo example bundled"),
        Command("reload the scene", opening.reload, ("F5",), apart=True),
        Command("next scene of the list", partial(opening.step_scene, by=1), ("Ctrl+PageDown",)),
        Command("previous scene of the list", partial(opening.step_scene, by=-1), ("Ctrl+PageUp",)),
        Command("train a scene", open_train, button="Train from photographs ...", apart=True,
                finds="photographs photos images video reconstruct create make new colmap"),
        Command("save the project", saving.save, ("Ctrl+S",), button="Save project", apart=True,
                now=lambda v: "save the project (changed)" if v.state.is_changed else ""),
        Command("save the project as ...", saving.save_as, ("Ctrl+Shift+S",)),
        Command("save a picture", saving.save_picture, ("P",), button="Save picture", icon="CAMERA",
                apart=True, finds="screenshot image png export capture snapshot render photo"),
        Command("save the view", saving.save_view, button="Save view"),
        Command("save a film of the path", saving.save_film, button="Save film",
                finds="video movie mp4 animation export record render"),
        Command("save a picture of the film's size", saving.save_sized_picture,
                button="Picture of this size"),
        Command("save the camera path", saving.save_path, button="Save path"),
        Command("quit", saving.quit_viewer, ("Ctrl+Q",), apart=True, finds="exit close leave end"),
    ),
    "Edit": (
        Command("search", queries.focus_search, ("Ctrl+F", "/"),
                finds="find query ask phrase text words language where"),
        Command("remove all queries", queries.remove_all, finds="clear reset delete search results answers"),
        _step("undo", editing.undo, "Ctrl+Z", finds="back revert"),
        _step("redo", editing.redo, "Ctrl+Shift+Z", "Ctrl+Y"),
        Command("gizmo: move, rotate, scale, box, off", editing.next_gizmo, ("G",), icon="UP_DOWN_LEFT_RIGHT",
                is_on=lambda v: v.state.edit_form.gizmo != "off", apart=True,
                finds="transform translate turn resize handles crop box"),
    ),
    "Select": (
        Command("select everything", editing.select_all, ("Ctrl+A",), button="All", is_edit=True),
        Command("select nothing", editing.select_none, ("Ctrl+D", "Ctrl+Shift+A"), button="None",
                is_edit=True),
        Command("invert the selection", editing.invert_selection, ("Ctrl+I",), button="Invert", is_edit=True),
        Command("select what the search found", editing.select_query, apart=True),
        Command("select everything like the selection", editing.select_alike, button="More like it"),
        Command("name the selection ...", editing.ask_for_name, ("F2",), finds="rename teach label call"),
        Command("grow the selection", editing.grow_selection, button="Grow"),
        Command("shrink the selection", editing.shrink_selection, button="Shrink"),
        Command("select with no tool: the left button turns the view", partial(editing.use_tool, tool=None),
                icon="HAND", is_on=_is("tools.tool", None), apart=True),
        *(Command(f"select: {tool}", partial(editing.use_tool, tool=tool), icon=TOOL_ICONS[tool],
                  is_on=_is("tools.tool", tool)) for tool in TOOLS),
        Command("hide the selection", editing.hide_selected, ("H",), button="Hide", apart=True),
        Command("isolate the selection", editing.isolate_selected, ("Shift+H",), button="Isolate"),
        Command("show all that is hidden", editing.show_hidden, ("U", "Alt+H"), button="Show all"),
        Command("delete the selection", editing.delete_selected, ("Delete",), button="Delete",
                finds="remove erase clean cut crop"),
        Command("export the selection ...", partial(saving.ask_export, title="scene", only_selected=True),
                button="Export selection ...", apart=True, finds="save extract cut out ply"),
    ),
    "View": (
        *(_display(button, number) for number, button in enumerate(BUTTONS, 1)),
        Command("say what is under the cursor", viewpoint.toggle_pointing, ("I",), icon="COMMENT_DOTS",
                is_on=_is("pointing"), apart=True, finds="inspect pick hover identify info"),
        Command("compare two displays", settings.toggle_wipe, ("V",), icon="TABLE_COLUMNS",
                is_on=_is("session.split.mode", "wipe"), finds="split side by side beside wipe divide"),
        Command("three levels side by side", settings.toggle_levels, icon="LAYER_GROUP",
                is_on=_is("session.split.mode", "levels")),
        Command("compare with another scene ...", opening.ask_for_beside,
                finds="split side by side beside difference"),
        _overlay("things", "boxes of what was found", "B", finds="bounding box outline 3d"),
        _overlay("cameras", "training cameras"),
        _overlay("cube", "axes", finds="compass orientation xyz cube"),
        _overlay("grid", "ground grid"),
        Command("measure a distance", settings.toggle_measuring, ("M",), icon="RULER",
                is_on=_is("session.ruler.measures"), apart=True, finds="ruler length size metre"),
        Command("pin a note to what is clicked", settings.toggle_pinning, ("N",), icon="NOTE_STICKY",
                is_on=_is("pins_notes"), finds="annotate annotation label comment text mark"),
        Command("click the middle of the image", editing.click_middle, ("X",)),
    ),
    "Camera": (
        Command("return to the opening view", viewpoint.reset_view, ("R", "Home"), button="Reset",
                icon="HOUSE", finds="reset camera home start"),
        Command("frame everything", viewpoint.frame_scene, ("Shift+F",), button="Frame all", icon="EXPAND",
                finds="fit all zoom extents whole center centre"),
        Command("focus on the latest result found", viewpoint.focus_result, ("F",), button="Focus",
                icon="CROSSHAIRS"),
        Command("previous training camera", partial(viewpoint.step_camera, by=-1), (",",), repeats=True,
                apart=True),
        Command("next training camera", partial(viewpoint.step_camera, by=1), (".",), repeats=True),
        Command("level the horizon", partial(viewpoint.move, step=level), button="Horizon", apart=True,
                finds="straighten roll upright"),
        Command("align the up axis with the view", partial(viewpoint.move, step=adopt_up),
                button="Align up axis"),
        *(Command(f"look from {where}", partial(viewpoint.look_from, side=side), (key,))
          for side, (where, key) in SIDES.items()),
        Command("orthographic view, and back", viewpoint.toggle_orthographic, ("O", "Keypad5"), apart=True,
                finds="perspective parallel projection 2d"),
        Command("bookmark this view", viewpoint.add_bookmark, ("Ctrl+B",), apart=True,
                finds="save camera remember favourite favorite"),
        Command("add a keyframe here", viewpoint.add_keyframe, ("K",), button="Add keyframe"),
        Command("make the path a turn around the view's centre", viewpoint.turn_around, button="Turntable",
                finds="turntable orbit spin rotate 360 film"),
        Command("play the camera path, or stop", viewpoint.toggle_playing, ("Shift+K",)),
    ),
    "Window": (
        Command("hide or show the panels", settings.toggle_panels, ("F11",),
                finds="full screen fullscreen clean interface sidebar ui"),
        Command("reset the layout", lambda v: settings.put(v.state, show_panel=True, resets_panels=True),
                apart=True, finds="default panels windows docking restore"),
        Command("light theme, or dark again",
                lambda v: settings.prefer(v, theme=OTHER_THEME[v.state.preferences.theme]),
                is_on=_is("preferences.theme", "light"),
                finds="appearance colours colors mode settings night day"),
        Command("larger text", partial(settings.scale_text, by=0.25), apart=True,
                finds="font size zoom interface bigger scale settings"),
        Command("smaller text", partial(settings.scale_text, by=-0.25)),
    ),
    "Help": (
        Command("find a command", settings.toggle_palette, ("Ctrl+Shift+P",)),
        Command("first steps, and list of keys", settings.toggle_help, ("F1", "?"), button="First steps",
                finds="help shortcuts keyboard manual tutorial documentation about"),
    ),
}  # fmt: skip
EXPORT_MENU = tuple(map(_export_as, saving.exports()))  # in the menu File
COMMANDS: tuple[Command, ...] = (
    *chain(*BY_MENU.values(), EXPORT_MENU),
    Command("close what lies over the scene", settings.escape, ("Esc",)),
)

BY_BUTTON = {command.button: command for command in COMMANDS if command.button}

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
    ("Keypad 4 6 8 2, + -", "turn around the centre, nearer, farther"),
    ("Tab, arrows, Enter", "travel in a panel; the box of the search completes by Tab, recalls by arrow up"),
    ("Ctrl + Tab", "to the next panel, the strip of icons, or the menus"),
    ("Menu, Shift + F10", "what can be done with a row of the outline"),
)


def with_key(text: str, act: Callable[[Viewer], object]) -> str:
    """Return `text` and, in brackets, the key of the command that does it, if it has one."""
    keys = next((command.keys for command in COMMANDS if command.act is act), ())
    return f"{text} ({keys[0]})" if keys else text


def matching(text: str, more: Sequence[Command] = (), recent: Sequence[str] = ()) -> list[Command]:
    """Return the commands with every word of `text`, those that find it among other words last; all for none.

    `more` commands are among them, and those that open `recent` scenes.
    """
    files = [Path(path) for path in recent]
    opens = (Command(f"open {f.parent.name}/{f.name}", partial(opening.open_file, path=f)) for f in files)
    words, commands = text.lower().split(), (*COMMANDS, *more, *opens)

    def missed(command: Command) -> int:
        """Return how many words are only among others that find it; more than there are if one is unknown."""
        own = command.does.lower()
        known = f"{own} {command.finds}"
        is_unknown = any(word not in known for word in words)
        return len(words) + 1 if is_unknown else sum(word not in own for word in words)

    found = [command for command in commands if missed(command) <= len(words)]
    return sorted(found, key=missed)
