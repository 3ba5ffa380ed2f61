"""Beside the cursor: what lies under it."""

from imgui_bundle import hello_imgui, imgui

from langsplat_core.query.describe import Words
from langsplat_core.scene import LEVELS
from langsplat_viewer.panels.style import muted
from langsplat_viewer.state import Hover
from langsplat_viewer.viewer import Viewer

UNSURE = 0.02  # a word less probable than this is not said


def draw(viewer: Viewer) -> None:
    """A tooltip, where something was found under the mouse."""
    hover = viewer.state.hover
    if hover is None or hover.found is None or not imgui.begin_tooltip():
        return
    imgui.push_text_wrap_pos(hello_imgui.em_size(24))
    sure = viewer.engine is not None and viewer.engine.basis.calibration is not None
    for name, words in zip(LEVELS, hover.found.words, strict=True):
        imgui.text_colored(muted(), name)
        imgui.same_line(hello_imgui.em_size(4.5))
        imgui.text_unformatted(said(words, sure))
    for line in figures(hover):
        imgui.text_colored(muted(), line)
    imgui.pop_text_wrap_pos()
    imgui.end_tooltip()


def said(words: Words, sure: bool) -> str:
    """ "teddy bear 64 %, toy 12 %": the most probable words of a place at one level, without percentages
    where none are `sure`."""
    likely = [word for word in words.words if word.probability > UNSURE]
    named = [word.phrase + (f" {100 * word.probability:.0f} %" if sure else "") for word in likely]
    of_colour = "" if words.colour is None else f"{words.colour.phrase}: "
    return of_colour + ", ".join(named) if named else "nothing known"


def figures(hover: Hover) -> list[str]:
    """Relevancies of what is shown, and the place."""
    assert hover.found is not None
    lines = [
        f"{phrase}: {value:.2f}" for phrase, value in zip(hover.phrases, hover.found.relevancy, strict=True)
    ]
    x, y, z = hover.found.position
    return [*lines, f"at {x:.2f}  {y:.2f}  {z:.2f}, {hover.found.depth:.2f} away"]
