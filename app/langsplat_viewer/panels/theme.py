"""The theme: colours, spacing, radius and type, of one family with those of `langsplat_core/web/page.css`."""

from collections.abc import Iterator
from contextlib import contextmanager

from imgui_bundle import ImVec2, ImVec4, hello_imgui, imgui

from langsplat_viewer.session import Preferences

THEMES = ("dark", "light")
COLOURS = {  # in each theme, as style sheets write them; what is see-through lies on ground, glass or raised
    "ink": ("#eef1f6", "#1b2130"),  # text
    "soft": ("#b6becd", "#4b5567"),  # secondary text
    "ground": ("#12161e", "#f3f5f9"),  # panels
    "glass": ("#12161ee6", "#f8f9fcf0"),  # what floats over the scene
    "raised": ("#1b202b", "#ffffff"),  # menus, lists, questions
    "field": ("#0000005c", "#ffffff"),  # boxes and the track of choices
    "line": ("#ffffff1c", "#1b213026"),
    "button": ("#ffffff14", "#1b213010"),
    "hover": ("#ffffff20", "#1b21301f"),
    "pressed": ("#ffffff30", "#1b21302b"),  # what is pressed or chosen
    "grab": ("#6b542f", "#f3cf94"),  # of sliders; numbers are read over it
    "accent": ("#ffb454", "#7a4100"),
    "good": ("#7bd88f", "#145c33"),
    "weak": ("#ffd166", "#6d4800"),
    "bad": ("#ffa796", "#9f2417"),
}
CLEAR = ImVec4(0, 0, 0, 0)
VEIL = ImVec4(0, 0, 0, 0.5)  # over what a question covers

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


def rgba(name: str, theme: str) -> tuple[float, float, float, float]:
    """Return the parts of a colour in a theme, each from 0 to 1."""
    red, green, blue, alpha = bytes.fromhex((COLOURS[name][THEMES.index(theme)][1:] + "ff")[:8])
    return red / 255, green / 255, blue / 255, alpha / 255


def apply(preferences: Preferences) -> None:
    """Have imgui draw everything in the theme and size that is preferred; once for every change."""
    style, chosen, scale = imgui.get_style(), preferences.theme, preferences.ui_scale
    names = {part: name for name, parts in PAINTED.items() for part in parts.split()}
    for slot in imgui.Col_:
        if slot != imgui.Col_.count:
            colour = ImVec4(*rgba(names[slot.name], chosen)) if slot.name in names else CLEAR
            style.set_color_(slot, colour)
    for slot in (imgui.Col_.modal_window_dim_bg, imgui.Col_.nav_windowing_dim_bg):
        style.set_color_(slot, VEIL)
    for name, (x, y) in SPACES.items():
        setattr(style, name, ImVec2(x * scale, y * scale))
    for name, size in SIZES.items():
        setattr(style, name, size * scale)
    hello_imgui.get_runner_params().imgui_window_params.background_color = ImVec4(*rgba("ground", chosen))
    style.window_border_size = style.popup_border_size = style.tab_border_size = 0
    style.child_border_size = style.frame_border_size = 1
    style.window_menu_button_position = imgui.Dir.none
    style.font_scale_main = scale


def colour(name: str) -> ImVec4:
    """Return a colour of the theme that imgui draws in, by its name there."""
    ground = imgui.get_style().color_(imgui.Col_.window_bg)
    return ImVec4(*rgba(name, "dark" if ground.x + ground.y + ground.z < 1.5 else "light"))


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
