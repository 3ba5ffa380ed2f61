"""Shared parts of panels: the scene's area of the window, colours, fonts, and small widgets."""

import sys
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from textwrap import fill
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import moderngl
from imgui_bundle import ImVec2, hello_imgui, imgui, imgui_ctx
from msgspec import Meta

from langsplat_core.arrays import Array
from langsplat_viewer.commands import BY_BUTTON, with_key
from langsplat_viewer.panels import theme
from langsplat_viewer.viewer import Viewer

T = TypeVar("T")

MAIN_DOCK = "MainDockSpace"  # hello_imgui's name for the whole window below the menus
OVER = (  # a window over the scene: it looks like a part of the image, and does not come to the front
    imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_bring_to_front_on_focus
)
FIXED = imgui.WindowFlags_.no_move | imgui.WindowFlags_.no_docking
FLOATS = (OVER | FIXED | imgui.WindowFlags_.always_auto_resize) & ~imgui.WindowFlags_.no_scrollbar
QUIET = FLOATS | imgui.WindowFlags_.no_inputs


@dataclass(frozen=True)
class Area:
    """The scene's part of the window, in window units (not pixels on a high-density screen)."""

    left: float
    top: float
    width: float
    height: float

    def fraction(self, x: float, y: float) -> tuple[float, float]:
        """Return a window position as fractions of the area; outside [0, 1] beyond its edges."""
        return (x - self.left) / self.width, (y - self.top) / self.height

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in whole window units, at least 1."""
        return max(round(self.width), 1), max(round(self.height), 1)

    @property
    def corners(self) -> tuple[ImVec2, ImVec2]:
        return ImVec2(self.left, self.top), ImVec2(self.left + self.width, self.top + self.height)

    def right_of(self, taken: float) -> "Area":
        """Return the area without its left `taken` window units."""
        return replace(self, left=self.left + taken, width=max(self.width - taken, 1.0))

    def columns(self, count: int) -> list["Area"]:
        """Return the area cut into columns of one width."""
        width = self.width / count
        return [Area(self.left + place * width, self.top, width, self.height) for place in range(count)]


def scene_area() -> Area:
    """Return the area that menus and docked panels leave free, at least one unit wide and high."""
    dock = hello_imgui.get_runner_params().docking_params.dock_space_id_from_name(MAIN_DOCK)
    node = imgui.internal.dock_builder_get_central_node(dock) if dock else None
    if node is None:  # in the first frame
        display = imgui.get_io().display_size
        return Area(0.0, 0.0, max(display.x, 1.0), max(display.y, 1.0))
    return Area(node.pos.x, node.pos.y, max(node.size.x, 1.0), max(node.size.y, 1.0))


def lying_over(*names: str) -> Iterator[tuple[ImVec2, ImVec2]]:
    """Return the corners of the windows with these names, and of undocked panels, that are over the scene."""
    docks = hello_imgui.get_runner_params().docking_params.dockable_windows
    return floating_windows(*names, *(dock.label for dock in docks))


def floating_windows(*names: str) -> Iterator[tuple[ImVec2, ImVec2]]:
    """Yield the corners of the windows with these names that are over the scene now."""
    for window in map(imgui.internal.find_window_by_name, names):
        node = None if window is None else window.dock_node
        if window is not None and window.active and (node is None or node.is_floating_node()):
            yield window.pos, window.pos + window.size


MOST_OVER = 0.94  # of the window that something which lies over it may take


def coloured(text: str, colour: str = "soft") -> None:
    """Write a text in a colour of the theme, by default that of secondary text."""
    imgui.text_colored(theme.colour(colour), text)


def small_wrapped(text: str, colour: str = "soft") -> None:
    """Write a text of any length, wrapped at the panel's edge."""
    with theme.styled(text=colour):
        imgui.text_wrapped(text)


def tip(text: str) -> None:
    """Show a tooltip while the mouse is over the last item."""
    if text and imgui.is_item_hovered():
        letters = int(imgui.get_main_viewport().size.x / width_of("n")) - 2  # that the window holds
        imgui.set_tooltip(fill(text, max(min(letters, 72), 8), break_on_hyphens=False))


def stoppable(label: str, fraction: float, ems: float, tag: str = "") -> bool:
    """Draw a bar `ems` wide with a button beside it, `tag` in its id; return whether that was clicked."""
    width = hello_imgui.em_size(ems)
    with theme.styled(plot_histogram="pressed"):
        room = width - 2 * imgui.get_style().item_inner_spacing.x
        imgui.progress_bar(fraction, ImVec2(width, 0), elided(label, room))
    imgui.same_line()
    return bool(imgui.button(f"Cancel{tag}"))


def width_of(text: str) -> float:
    """Return the width of a text, window units."""
    return float(imgui.calc_text_size(text).x)


def button_width(label: str) -> float:
    """Return the width of a button, window units."""
    return width_of(label.partition("##")[0]) + 2 * imgui.get_style().frame_padding.x


def beside_button(label: str) -> float:
    """Return the width, as imgui takes it, of an item that leaves room for a button at the end of its row."""
    return -button_width(label) - imgui.get_style().item_spacing.x


def beside(label: str, more: float = 0.0) -> None:
    """Go on in the last row, unless a widget with this label and `more` window units does not fit there."""
    imgui.same_line()
    if imgui.get_content_region_avail().x < button_width(label) + more:
        imgui.new_line()


def button(label: str, about: str = "", *, enabled: bool = True) -> bool:
    """Draw a button with a tip, that can be clicked where it is `enabled`; return whether it was."""
    with disabled(not enabled):
        clicked = bool(imgui.button(label))
    tip(about)
    return clicked


def small(label: str, side: float) -> bool:
    """Draw a square button without a frame, for a letter or an icon; return whether it was clicked."""
    padding = ImVec2(0, imgui.get_style().frame_padding.y)
    with theme.styled(frame_padding=padding, frame_border_size=0.0, button=theme.CLEAR):
        return bool(imgui.button(label, ImVec2(side, side)))


def next_button(label: str, about: str = "", *, enabled: bool = True) -> bool:
    """Draw a button in the last row, where there is room; return whether it was clicked."""
    beside(label)
    return button(label, about, enabled=enabled)


def verbs(viewer: Viewer, *buttons: str, disabled: Container[str] = ()) -> None:
    """Draw the buttons of commands beside each other, each with its words and key as a tip."""
    for place, label in enumerate(buttons):
        if place:
            beside(label)
        command = BY_BUTTON[label]
        if button(label, with_key(command.does.capitalize(), command.act), enabled=label not in disabled):
            command.act(viewer)


def box(label: str, hint: str, text: str, width: float = -1.0) -> tuple[bool, str]:
    """Draw a text box, as wide as the row by default; return whether Enter was pressed, and the text."""
    imgui.set_next_item_width(width)
    flags = imgui.InputTextFlags_.enter_returns_true
    entered, typed = imgui.input_text_with_hint(label, hint, text, flags)
    return bool(entered), str(typed)


def kept_box(viewer: Viewer, label: str, hint: str, button: str) -> str | None:
    """Draw a box and a button that does what Enter does; return the text once it is entered."""
    drafts = viewer.state.drafts
    entered, drafts[label] = box(label, hint, drafts.get(label, ""), beside_button(button))
    imgui.same_line()
    entered |= bool(imgui.button(button))
    typed = drafts[label]
    if entered or not typed:
        del drafts[label]
    return typed if entered else None


@cache
def _titled(kind: Any, panel: str) -> list[tuple[str, Any, Meta]]:
    """Return name, type and annotation of a dataclass's fields that have their widget in a panel."""
    found = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        metas = hint.__metadata__ if get_origin(hint) is Annotated else ()
        titled = [
            meta for meta in metas if isinstance(meta, Meta) and (meta.extra or {}).get("panel") == panel
        ]
        found += [(name, hint.__origin__, meta) for meta in titled]
    return found


def draw_fields(holder: Any, panel: str) -> dict[str, Any]:
    """Draw a widget for every field of a dataclass that has a title and names the panel.

    Return their values: a check box for a bool, a slider for a number, a box for a text, else a list.
    """
    values: dict[str, Any] = {}
    holders: Any = type(holder)
    for name, kind, meta in _titled(holders, panel):
        value, title = getattr(holder, name), meta.title or name
        if kind is bool:
            value = imgui.checkbox(title, value)[1]
        elif kind is str:
            imgui.text(title)
            imgui.set_next_item_width(-1)
            value = imgui.input_text_with_hint(f"##{title}", meta.description or "", value)[1]
        elif kind in (float, int):
            low, high = float(meta.ge or 0), float(meta.le or 1)
            text = "%.2f" if kind is float else "%.0f"
            value = kind(slider(title, value, (low, high), text, logarithmic=low > 0))
        else:
            choices = list(get_args(kind))
            leave_room(title, 11.0)
            value = choices[imgui.combo(title, choices.index(value), choices)[1]]
        tip(meta.description or "")
        values[name] = value
    return values


@contextmanager
def disabled(is_so: bool) -> Iterator[None]:
    """Draw what follows grey, and take no click for it, where `is_so`."""
    imgui.begin_disabled(is_so)
    yield
    imgui.end_disabled()


@contextmanager
def floating(
    name: str, at: ImVec2, pivot: ImVec2 | None = None, flags: int = FLOATS, padding_em: float = 0.7
) -> Iterator[None]:
    """Draw what follows on glass over the scene, by default as large as it is.

    `pivot`: the place in it, as fractions of its size, that lies `at`; by default the upper left corner.
    """
    imgui.set_next_window_pos(at, imgui.Cond_.always, pivot or ImVec2(0, 0))
    padding = hello_imgui.em_to_vec2(padding_em, padding_em)
    rounding = theme.FLOATING * imgui.get_style().font_scale_main
    with theme.styled(
        window_rounding=rounding, window_border_size=1.0, window_padding=padding, window_bg="glass"
    ):
        imgui.begin(name, None, flags)
    yield
    imgui.end()


def row(label: str) -> None:
    """Begin a row with a label, in a column with those above and below."""
    imgui.align_text_to_frame_padding()
    coloured(label)
    imgui.same_line(max(hello_imgui.em_size(5.2), width_of(label) + 2 * imgui.get_style().item_spacing.x))


def choice(choices: Mapping[T, str], chosen: T, tips: Mapping[T, str] | None = None) -> T:
    """Draw a row of joined buttons, one for each of the `choices`; return the one that is chosen now.

    The row is as wide as there is room, and broken where that is too little.
    """
    room, padding = imgui.get_content_region_avail().x, imgui.get_style().frame_padding
    widths = {value: button_width(label) - padding.x for value, label in choices.items()}
    rows: list[list[T]] = [[]]
    for value, width in widths.items():
        if rows[-1] and sum(widths[other] for other in rows[-1]) + width > room:
            rows.append([])
        rows[-1].append(value)
    height, paint = imgui.get_frame_height(), imgui.get_window_draw_list()
    start = imgui.get_cursor_screen_pos()
    end = ImVec2(start.x + room, start.y + len(rows) * height)
    rounding = imgui.get_style().frame_rounding
    paint.add_rect_filled(start, end, imgui.get_color_u32(imgui.Col_.frame_bg), rounding)
    paint.add_rect(start, end, imgui.get_color_u32(imgui.Col_.border), rounding)
    spacing, padding = ImVec2(0, 0), ImVec2(0, padding.y)
    with (
        imgui_ctx.begin_group(),
        theme.styled(item_spacing=spacing, frame_padding=padding, frame_border_size=0.0),
    ):
        for row in rows:
            more = (room - sum(widths[value] for value in row)) / len(row)
            for place, value in enumerate(row):
                if place:
                    imgui.same_line()
                is_chosen = value == chosen
                look = "pressed" if is_chosen else theme.CLEAR
                with theme.styled(button=look, text="ink" if is_chosen else "soft"):
                    clicked = imgui.button(choices[value], ImVec2(widths[value] + more, height))
                tip(tips[value] if tips else "")
                chosen = value if clicked else chosen
    return chosen


def slider(
    label: str,
    value: float,
    limits: tuple[float, float],
    text: str = "%.2f",
    *,
    logarithmic: bool = False,
    ems: float = 11.0,
) -> float:
    """Draw a slider, `ems` wide where there is room; return the value that it has now."""
    leave_room(label, ems)
    flags = imgui.SliderFlags_.always_clamp
    if logarithmic:
        flags |= imgui.SliderFlags_.logarithmic
    changed, new = imgui.slider_float(label, value, *limits, text, flags)
    return new if changed else value  # what comes back unchanged has been rounded


def begin_list(name: str, rows: float = 14.5) -> bool:
    """Begin a part that is as high as what it lists, but for more than so many rows, which are scrolled."""
    most = ImVec2(imgui.FLT_MAX, rows * imgui.get_frame_height_with_spacing())
    imgui.set_next_window_size_constraints(ImVec2(0, 0), most)
    flags = imgui.ChildFlags_.nav_flattened | imgui.ChildFlags_.auto_resize_y
    return bool(imgui.begin_child(name, ImVec2(0, 0), flags))


@dataclass(frozen=True)
class Row:
    """A row of a list."""

    text: str
    chosen: bool = False
    about: str = ""  # its tip


def listed(
    name: str, rows: Sequence[Row], empty: str = "", *, keeps_chosen: bool = False
) -> tuple[int | None, int | None]:
    """Draw a list, each row with a button that takes it off.

    Return the numbers of the row that was clicked and of the one taken off. `empty` is said in place of rows.
    `keeps_chosen`: the chosen one cannot be taken off.
    """
    clicked = gone = None
    if begin_list(name):
        if not rows:
            small_wrapped(empty)
        side, right = imgui.get_frame_height(), imgui.get_content_region_avail().x
        room = right - side - imgui.get_style().item_spacing.x
        for number, row in enumerate(rows):
            with imgui_ctx.push_id(str(number)):
                imgui.align_text_to_frame_padding()
                label = f"{elided(row.text, room)}##{name}"
                clicked = number if imgui.selectable(label, row.chosen, size=ImVec2(room, 0))[0] else clicked
                tip(row.about)
                imgui.same_line(imgui.get_cursor_start_pos().x + right - side)
                with disabled(keeps_chosen and row.chosen):
                    gone = number if small("x", side) else gone
                tip("Take it off the list")
    imgui.end_child()
    return clicked, gone


class Picture:
    """An image that is drawn smaller than it is, as a texture, uploaded where it is another than before."""

    def __init__(self) -> None:
        self._image: Array | None = None  # what the texture has
        self._texture: moderngl.Texture | None = None

    def texture(self, image: Array) -> moderngl.Texture:
        """Return the texture of an (H, W, 3) uint8 image, row 0 on top."""
        if self._texture is None or self._image is not image:
            if self._texture is not None:
                self._texture.release()
            size = (image.shape[1], image.shape[0])
            texture = moderngl.get_context().texture(size, 3, image.tobytes(), alignment=1)
            texture.build_mipmaps()
            texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
            texture.repeat_x = texture.repeat_y = False
            self._texture, self._image = texture, image
        return self._texture


def leave_room(label: str, ems: float) -> None:
    """Make the next widget `ems` wide, or what is left of the row beside its label."""
    label_width = width_of(label) + imgui.get_style().item_inner_spacing.x
    room = imgui.get_content_region_avail().x - label_width
    imgui.set_next_item_width(max(min(hello_imgui.em_size(ems), room), hello_imgui.em_size(2)))


def fitting(width_em: float, height_em: float) -> ImVec2:
    """Return the size of a window over the scene, given in widths of an m, within the window's room."""
    size, room = hello_imgui.em_to_vec2(width_em, height_em), imgui.get_main_viewport().work_size
    return ImVec2(min(size.x, MOST_OVER * room.x), min(size.y, MOST_OVER * room.y))


def elided(text: str, room: float, width_of: Callable[[str], float] = width_of) -> str:
    """Return `text` in one line, cut with "..." where it is wider than `room`."""
    text = " ".join(text.splitlines())
    if width_of(text) <= room:
        return text
    low, high = 0, len(text)  # as many letters as fit
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if width_of(text[:middle] + "...") <= room else (low, middle - 1)
    return text[:low].rstrip() + "..."


# Letters: the window's own font, and behind it others for what that does not have.

FOLDERS = {
    "linux": ("/usr/share/fonts", "/usr/local/share/fonts", "~/.local/share/fonts", "~/.fonts"),
    "darwin": ("/System/Library/Fonts", "/Library/Fonts", "~/Library/Fonts"),
    "win32": ("C:/Windows/Fonts",),
}
# Fonts with the scripts of East Asia and others with many, the first that is there is taken.
WIDE = (
    "NotoSansCJK-Regular.ttc", "NotoSansCJK-VF.ttc", "NotoSansCJKjp-Regular.otf", "SourceHanSans.ttc",
    "DroidSansFallbackFull.ttf", "DroidSansFallback.ttf", "wqy-microhei.ttc", "wqy-zenhei.ttc", "unifont.ttf",
    "Arial Unicode.ttf", "PingFang.ttc", "Hiragino Sans GB.ttc", "msyh.ttc", "YuGothM.ttc", "malgun.ttf",
)  # fmt: skip
BUNDLED = {  # package -> its file; pictographs, and letters: Latin, Greek, Cyrillic, Hebrew, Arabic, more
    "matplotlib": "mpl-data/fonts/ttf/DejaVuSans.ttf",
    "imgui_bundle": "demos_assets/fonts/NotoEmoji-Regular.ttf",
}


def load_fonts() -> None:
    """Load the theme's font, with icons and what else there is merged into it; a callback.

    Letters are drawn into the texture when they first appear, so that a large font costs nothing until then.
    """
    hello_imgui.load_font(theme.FONT, theme.FONT_SIZE)
    merged = hello_imgui.FontLoadingParams()
    merged.merge_to_last_font = True
    hello_imgui.load_font("fonts/Font_Awesome_6_Free-Solid-900.otf", theme.FONT_SIZE, merged)
    merged.inside_assets = False
    for path in fallbacks():
        hello_imgui.load_font(str(path), theme.FONT_SIZE, merged)


def fallbacks() -> list[Path]:
    """Return font files to look letters up in, in this order."""
    specs = ((find_spec(package), file) for package, file in BUNDLED.items())
    found = [Path(spec.origin).parent / file for spec, file in specs if spec is not None and spec.origin]
    folders = (Path(folder).expanduser() for folder in FOLDERS.get(sys.platform, ()))
    installed = {path.name: path for folder in folders for path in folder.rglob("*.[to]t[fc]")}
    paths = (*found, *[installed[name] for name in WIDE if name in installed][:1])
    return [path for path in paths if path.is_file()]
