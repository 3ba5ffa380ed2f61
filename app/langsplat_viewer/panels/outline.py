"""The panel "Outline", the menu of a clicked thing, and the legend of the colours of things."""

from typing import Any

from imgui_bundle import ImVec2, ImVec4, hello_imgui, imgui, imgui_ctx
from imgui_bundle import icons_fontawesome_6 as icons

from langsplat_core.query.describe import OR
from langsplat_core.query.inventory import Outline
from langsplat_viewer.actions import outline
from langsplat_viewer.actions.outline import Target
from langsplat_viewer.panels import theme, ui
from langsplat_viewer.panels.overlays import beside_search, clicked, legend, parts_of
from langsplat_viewer.viewer import Viewer

LEGEND_ROWS, LEGEND_EM = 8, 9.0
MENU = "menu of a thing"


def draw(viewer: Viewer) -> None:
    """Draw the panel "Outline": a box that filters, and the tree."""
    view = outline.wanted(viewer)
    if view.problem:
        ui.small_wrapped(view.problem)
        return
    imgui.set_next_item_width(-1)
    drafts = viewer.state.drafts
    _, typed = imgui.input_text_with_hint("##filter", "filter", drafts.get("##filter", ""))
    drafts["##filter"] = typed
    if ui.begin_list("rows"):
        for row in outline.filtered(viewer, view.roots, typed):
            _row(viewer, row)
    imgui.end_child()


def _row(viewer: Viewer, row: Outline) -> None:
    with imgui_ctx.push_id(f"node {row.node}"):
        side, spacing = imgui.get_frame_height(), imgui.get_style().item_spacing.x
        right = imgui.get_cursor_pos_x() + imgui.get_content_region_avail().x
        flags = imgui.TreeNodeFlags_.open_on_arrow | imgui.TreeNodeFlags_.allow_overlap
        flags |= imgui.TreeNodeFlags_.span_avail_width | imgui.TreeNodeFlags_.no_tree_push_on_open
        flags |= imgui.TreeNodeFlags_.leaf if not row.parts else 0
        colour = outline.colour_of(viewer, row.node)
        name = outline.name_of(viewer, row)
        named, sure = outline.sure_of(viewer, row)
        taken = (1 if colour is None else 2) * (side + spacing)
        room = imgui.get_content_region_avail().x - taken - imgui.get_tree_node_to_label_spacing()
        label = ui.elided(name + sure, room)
        imgui.align_text_to_frame_padding()
        with theme.styled(text="ink" if named else "soft"):
            opened = imgui.tree_node_ex(f"{label}###row", flags)
        if _chosen("thing"):
            outline.visit(viewer, row.node)
        outlined = f"outlined in {row.votes[0]} of {sum(row.votes)} photographs"
        ui.tip(f"{name}: {row.count:,} Gaussians, {_sides(row)} world units, {outlined}")
        if imgui.begin_popup_context_item("thing"):
            _things_menu(viewer, row.node)
            imgui.end_popup()
        left = room - ui.width_of(label) - 2 * spacing
        texts = (f"{row.count:,}   {_sides(row)}", f"{row.count:,}")
        said = next((text for text in texts if ui.width_of(text) < left), "")
        if said:
            imgui.same_line(right - taken - ui.width_of(said))
            ui.coloured(said)
        if colour is not None:
            imgui.same_line(right - 2 * side - spacing)
            _swatch(colour, side)
        _eye(viewer, row.node, right - side, side)
    if opened:
        imgui.indent()
        for part in row.parts:
            _row(viewer, part)
        imgui.unindent()


def _chosen(menu: str) -> bool:
    """Return whether the last row was clicked, or Enter or Space pressed on it; the menu key opens `menu`."""
    if imgui.is_item_focused():
        keys, shift = imgui.Key, imgui.get_io().key_shift
        if imgui.is_key_pressed(keys.menu) or (shift and imgui.is_key_pressed(keys.f10)):
            imgui.open_popup(menu)
        if any(imgui.is_key_pressed(key, False) for key in (keys.enter, keys.keypad_enter, keys.space)):
            if imgui.is_item_toggled_open():  # arrows open and close
                place, rows = imgui.get_item_id(), imgui.get_state_storage()
                rows.set_int(place, 1 - rows.get_int(place))
            return True
    return imgui.is_item_clicked() and not imgui.is_item_toggled_open()


def _sides(row: Outline) -> str:
    return " x ".join(f"{side:.2g}" for side in row.size)


def _eye(viewer: Viewer, node: int, left: float, side: float) -> None:
    hidden = bool(outline.hidden_nodes(viewer)[node])
    imgui.same_line(left)
    text, icon = theme.colour("soft"), icons.ICON_FA_EYE_SLASH if hidden else icons.ICON_FA_EYE
    with theme.styled(text=ImVec4(text.x, text.y, text.z, 0.45) if hidden else "ink"):
        clicked = ui.small(f"{icon}###eye", side)
    if clicked:
        act = outline.show if hidden else outline.hide
        act(viewer, node)
    ui.tip("Show it again" if hidden else "Hide it")


def _swatch(colour: tuple[float, float, float], side: float) -> None:
    flags = imgui.ColorEditFlags_.no_tooltip | imgui.ColorEditFlags_.no_picker
    imgui.color_button("##colour", ImVec4(*colour, 1.0), flags, ImVec2(side, side))


# The menu of a thing.


class ThingsMenu:
    """Opens where the right button is clicked on the scene, without a drag."""

    def __init__(self) -> None:
        self._at: Any = None  # (3,) on the surface

    def draw(self, viewer: Viewer, area: ui.Area) -> None:
        """Draw the menu while it is open; once per frame, after the panels."""
        if clicked(area, 1):
            mouse = imgui.get_io().mouse_pos
            place = area.fraction(mouse.x, mouse.y)
            self._at = None if viewer.surface is None else viewer.surface.point_at(*place)
            if self._at is not None and viewer.searchable() is not None:
                imgui.open_popup(MENU)
        if imgui.begin_popup(MENU):
            _things_menu(viewer, self._at)
            imgui.end_popup()


def _things_menu(viewer: Viewer, target: Target) -> None:
    for label, act in (
        ("Select", outline.select),
        ("Focus", outline.visit),
        ("Find more like this", outline.find_alike),
        ("Hide", outline.hide),
    ):
        if imgui.menu_item(label, "", False)[0]:
            act(viewer, target)
    imgui.separator()
    entered, name = ui.box("##name this", "name this", "", hello_imgui.em_size(11))
    if entered and name.strip():
        outline.give_name(viewer, target, name.strip())
        imgui.close_current_popup()


# The legend of displays that have a colour for each thing.


def draw_legend(viewer: Viewer, area: ui.Area, free: ui.Area) -> None:
    """Draw colours and names of the largest things in the image, where latents or the tree are shown."""
    state = viewer.state
    if state.session.picture.display not in ("latent", "tree") or state.session.split.columns > 1:
        return
    outline.wanted(viewer)  # is looked for, where it is not known yet
    seen: dict[str, tuple[float, float, float]] = {}
    for row in outline.in_view(viewer):
        if (colour := outline.colour_of(viewer, row.node)) is not None:
            is_sure, name = outline.sure_of(viewer, row)[0], outline.name_of(viewer, row).split(OR)[0]
            seen.setdefault(name if is_sure else f"{name}?", colour)
        if len(seen) == LEGEND_ROWS:
            break
    if not seen:
        return
    place = beside_search(parts_of(area, state.session.split)[0], free, 2 * len(seen))
    if place is None:
        return
    with legend("legend" if place is free else "left legend", place):  # together with what is there
        for name, colour in seen.items():
            _swatch(colour, imgui.get_text_line_height())
            imgui.same_line()
            imgui.text_unformatted(ui.elided(name, hello_imgui.em_size(LEGEND_EM)))
