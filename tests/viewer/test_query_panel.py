"""What the search panel says of an answer, written down instead of drawn."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from langsplat_core.scene import Calibration, Reading
from langsplat_viewer.actions import opening, queries
from langsplat_viewer.panels import search, style
from langsplat_viewer.panels import search as panel
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import blob_scene, calibrated_for, language
from tests.support.windowless import SCENES, settle


class Flags:
    """Every flag of a set of flags is 0."""

    def __getattr__(self, name: str) -> int:
        return 0


class Paper:
    """Takes the place of imgui: notes every text; nothing is clicked, and the mouse is everywhere."""

    def __init__(self) -> None:
        self.said: list[str] = []
        spacing = SimpleNamespace(x=4.0, y=4.0)
        self.values = {
            "calc_text_size": spacing,
            "get_content_region_avail": spacing,
            "get_style": SimpleNamespace(
                frame_padding=spacing,
                item_spacing=spacing,
                color_=lambda which: SimpleNamespace(x=0, y=0, z=0),
            ),
            "get_frame_height": 10.0,
            "get_frame_height_with_spacing": 14.0,
            "get_text_line_height_with_spacing": 12.0,
            "begin_child": True,
            "selectable": (False, False),
            "get_cursor_pos_x": 0.0,
            "input_text_with_hint": (False, ""),
            "is_item_hovered": True,
        }

    InputTextCallbackData = object

    def __getattr__(self, name: str):
        if name.endswith("_"):  # a set of flags
            return Flags()

        def call(*args: object, **options: object) -> object:
            if name in ("text", "text_colored", "set_tooltip"):
                self.said.append(str(args[-1]))
            return self.values.get(name, False)

        return call


@pytest.fixture
def paper(monkeypatch) -> Iterator[Paper]:
    made = Paper()
    for module in (panel, search, search):
        monkeypatch.setattr(module, "imgui", made)
    for module in (panel, search):
        monkeypatch.setattr(module, "small_wrapped", lambda text, colour: made.said.append(text))
    monkeypatch.setattr(style, "imgui", made)
    monkeypatch.setattr(search.cut, "draw", lambda viewer, query, result: None)
    return made


def searched(viewer: Viewer, phrase: str, calibration: Calibration | None = None) -> Viewer:
    field = replace(language(), reading=Reading(calibration=calibration))
    SCENES["asked.ply"] = replace(blob_scene(), language=field)
    try:
        opening.open_scene(viewer, Path("asked.ply"))
        settle(viewer)
    finally:
        del SCENES["asked.ply"]
    queries.ask(viewer, phrase)
    settle(viewer)
    return viewer


@pytest.mark.parametrize(
    ("logit", "verdict", "percent"),
    [(9.0, "found", "100 %"), (1.0, "weak match", "73 %"), (-3.0, "not here", "5 %")],
)
def test_the_verdict_and_how_likely_it_is(viewer, paper, logit, verdict, percent):
    panel.draw(searched(viewer, "mug", calibrated_for("mug", logit)))
    assert [text for text in paper.said if text in ("found", "weak match", "not here")] == [verdict]
    assert f"{percent} likely to be there" in paper.said


def test_without_a_calibration_nothing_is_said_to_be_likely(viewer, paper):
    panel.draw(searched(viewer, "mug"))
    assert viewer.engine.basis.short in paper.said
    assert viewer.engine.basis.long in " ".join(" ".join(paper.said).split())
    assert "found" in paper.said
    assert not any("likely" in text for text in paper.said)
    assert not any("read as" in text for text in paper.said)


def test_structure_is_said_as_it_was_read(viewer, paper):
    panel.draw(searched(viewer, "mug or book"))
    assert "read as: mug  or  book" in paper.said


def test_the_list_takes_the_room_that_the_details_leave_it():
    assert search.rows_shown(0, 40.0) == 1  # a line says what will be there
    assert search.rows_shown(3, 12.0) == 3
    assert search.rows_shown(9, 12.0) == 3.5  # as much as a low window has
    assert search.rows_shown(9, 17.3) == 7.5
    assert search.rows_shown(9, 40.0) == 9
