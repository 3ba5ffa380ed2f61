"""The theme: colours, spacing, radius and type, of one family with those of `langsplat_core/web/page.css`."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from imgui_bundle import ImVec2, ImVec4, hello_imgui, imgui

from langsplat_viewer.session import Preferences


@dataclass(frozen=True)
class Theme:
    """Colours as style sheets write them; what is see-through lies on ground, glass or what is raised."""

    ink: str  # text
    soft: str  # secondary text
    ground: str  # panels
    glass: str  # what floats over the scene
    raised: str  # menus, lists, questions
    field: str  # boxes and the track of choices
    line: str
    button: str
    hover: str
    pressed: str  # what is pressed or chosen
    grab: str  # of sliders; numbers are read over it
    accent: str
    good: str
    weak: str
    bad: str


DARK = Theme(
    *("#eef1f6", "#b6becd", "#12161e", "#12161ee6", "#1b202b", "#0000005c", "#ffffff1c", "#ffffff14"),
    *("#ffffff20", "#ffffff30", "#6b542f", "#ffb454", "#7bd88f", "#ffd166", "#ffa796"),
)
LIGHT = Theme(
    *("#1b2130", "#4b5567", "#f3f5f9", "#f8f9fcf0", "#ffffff", "#ffffff", "#1b213026", "#1b213010"),
    *("#1b21301f", "#1b21302b", "#f3cf94", "#7a4100", "#145c33", "#6d4800", "#9f2417"),
)
THEMES = {"dark": DARK, "light": LIGHT}
CLEAR = ImVec4(0, 0, 0, 0)
VEIL = "#00000080"  # over what a question covers

# imgui's names of what has a colour of the theme; what is not named is clear.
PAINTED = {
    "ink": "text input_text_cursor",
    "soft": "text_disabled",
    "ground": "window_bg title_bg title_bg_active title_bg_collapsed menu_bar_bg",
    "raised": "popup_bg",
    "field": "frame_bg checkbox_selected_bg",
    "line": "border separator table_border_light table_border_strong tree_lines",
    "button": "button header scrollbar_grab table_header_bg tab_dimmed_selected",
    "hover": "frame_bg_hovered button_hovered header_hovered scrollbar_grab_hovered tab_hovered "
    "separator_hovered",
    "pressed": "frame_bg_active button_active header_active scrollbar_grab_active tab_selected "
    "separator_active",
    "grab": "slider_grab slider_grab_active text_selected_bg docking_preview",
    "accent": "check_mark plot_lines plot_lines_hovered plot_histogram plot_histogram_hovered text_link "
    "nav_cursor drag_drop_target nav_windowing_highlight tab_selected_overline unsaved_marker",
}

# Window units at a scale of 1.
SPACES = {
    "window_padding": (12.0, 10.0),
    "frame_padding": (9.0, 4.0),
    "item_spacing": (8.0, 7.0),
    "item_inner_spacing": (6.0, 4.0),
    "cell_padding": (4.0, 2.0),
}
SIZES = {
    "frame_rounding": 8.0,
    "child_rounding": 8.0,
    "popup_rounding": 10.0,
    "window_rounding": 10.0,
    "grab_rounding": 6.0,
    "scrollbar_rounding": 6.0,
    "tab_rounding": 6.0,
    "image_rounding": 6.0,
    "indent_spacing": 18.0,
    "scrollbar_size": 11.0,
    "grab_min_size": 14.0,
}
FLOATING = 14.0  # radius of what floats over the scene
PILL = 99.0  # that of a button with round ends
FONT_SIZE = 15.0
FONT = "fonts/Roboto/Roboto-Regular.ttf"  # of imgui-bundle


def rgba(colour: str) -> tuple[float, float, float, float]:
    """Return the parts of a colour, each from 0 to 1."""
    red, green, blue, alpha = bytes.fromhex((colour[1:] + "ff")[:8])
    return red / 255, green / 255, blue / 255, alpha / 255


def apply(preferences: Preferences) -> None:
    """Have imgui draw everything in the theme and size that is preferred; once for every change."""
    style, chosen, scale = imgui.get_style(), THEMES[preferences.theme], preferences.ui_scale
    names = {part: name for name, parts in PAINTED.items() for part in parts.split()}
    for slot in imgui.Col_:
        if slot != imgui.Col_.count:
            colour = ImVec4(*rgba(getattr(chosen, names[slot.name]))) if slot.name in names else CLEAR
            style.set_color_(slot, colour)
    for slot in (imgui.Col_.modal_window_dim_bg, imgui.Col_.nav_windowing_dim_bg):
        style.set_color_(slot, ImVec4(*rgba(VEIL)))
    for name, (x, y) in SPACES.items():
        setattr(style, name, ImVec2(x * scale, y * scale))
    for name, size in SIZES.items():
        setattr(style, name, size * scale)
    hello_imgui.get_runner_params().imgui_window_params.background_color = ImVec4(*rgba(chosen.ground))
    style.window_border_size = style.popup_border_size = style.tab_border_size = 0
    style.child_border_size = style.frame_border_size = 1
    style.window_menu_button_position = imgui.Dir.none
    style.font_scale_main = scale


def colour(name: str) -> ImVec4:
    """Return a colour of the theme that imgui draws in, by its name there."""
    ground = imgui.get_style().color_(imgui.Col_.window_bg)
    shown = DARK if ground.x + ground.y + ground.z < 1.5 else LIGHT
    return ImVec4(*rgba(getattr(shown, name)))


@contextmanager
def styled(**values: str | ImVec4 | ImVec2 | float) -> Iterator[None]:
    """Draw what follows in another style: colours, here or by their names in the theme, and sizes."""
    colours = 0
    for name, value in values.items():
        if isinstance(value, str | ImVec4):
            imgui.push_style_color(imgui.Col_[name], colour(value) if isinstance(value, str) else value)
            colours += 1
        else:
            imgui.push_style_var(imgui.StyleVar_[name], value)
    yield
    imgui.pop_style_color(colours)
    imgui.pop_style_var(len(values) - colours)
