"""The search panel: a box to type in, and the list of what was searched."""

from typing import get_args

from imgui_bundle import imgui

from langsplat_core.config import LevelChoice
from langsplat_core.query.engine import no_field
from langsplat_core.scene import CANONICAL_PHRASES
from langsplat_viewer import actions
from langsplat_viewer.panels import answers, query_box
from langsplat_viewer.panels.style import bad, beside_boxed, muted, small_wrapped, tip
from langsplat_viewer.viewer import Viewer

CHOICES: tuple[LevelChoice, ...] = get_args(LevelChoice)


def draw(viewer: Viewer) -> None:
    """Box, level, list."""
    scene = viewer.state.scene
    if scene is not None and scene.language is None:
        small_wrapped(no_field(scene), muted())
        return
    imgui.begin_disabled(scene is None)
    imgui.begin_group()
    query_box.draw(viewer)
    imgui.end_group()
    hovered = imgui.is_item_hovered(imgui.HoveredFlags_.allow_when_disabled)
    if scene is None and hovered and imgui.is_mouse_clicked(imgui.MouseButton_.left):
        actions.mute_letters(viewer, True)  # what is typed now was meant for the box
    _level(viewer)
    imgui.end_disabled()
    if viewer.engine is not None:
        basis = viewer.engine.basis
        small_wrapped(basis.short, bad() if basis.guesses else muted())
        tip(basis.long)
    answers.draw(viewer)
    _canonical(viewer)


def _canonical(viewer: Viewer) -> None:
    """What everything is compared with."""
    if not imgui.collapsing_header("Compared with"):
        return
    state = viewer.state
    small_wrapped("a place is relevant where it is nearer to the phrase than to all of these", muted())
    imgui.set_next_item_width(-1)
    hint = ", ".join(state.canonical or CANONICAL_PHRASES)
    flags = imgui.InputTextFlags_.enter_returns_true
    entered, typed = imgui.input_text_with_hint("##canonical", hint, state.canonical_typed, flags)
    actions.type_canonical(viewer, typed)
    if entered:
        actions.set_canonical(viewer, typed)
    if state.canonical and imgui.button("The scene's own"):
        actions.set_canonical(viewer, "")


def _level(viewer: Viewer) -> None:
    imgui.align_text_to_frame_padding()
    imgui.text("Level")
    for choice in CHOICES:
        beside_boxed(choice)
        if imgui.radio_button(choice, viewer.state.level == choice):
            actions.set_level(viewer, choice)
    if imgui.is_item_hovered():
        imgui.set_tooltip("auto: the level that answers best")
