"""The one list of displays, and what is derived from it."""

import re
from typing import get_args

from langsplat_core.config import Display
from langsplat_core.display.displays import DISPLAYS, NUMBERS, Extra, shader_defines
from langsplat_core.raster.opengl.scene_textures import shader

SHADER = shader("compose.frag", 330, "langsplat_core.display", **shader_defines())


def test_the_table_has_exactly_the_displays_that_the_settings_know():
    assert set(DISPLAYS) == set(get_args(Display))
    assert all(name == row.name for name, row in DISPLAYS.items())
    assert {row.extra for row in DISPLAYS.values()} == set(get_args(Extra))


def test_answers_need_a_language_field():
    assert all(row.needs_field for row in DISPLAYS.values() if row.needs_query)


def test_the_shader_tells_displays_apart_by_their_place_in_the_table():
    assert list(NUMBERS.values()) == list(range(len(DISPLAYS)))
    for name, number in NUMBERS.items():
        assert f"#define DISPLAY_{name.upper()} {number}\n" in SHADER
    code = SHADER[SHADER.index("void main") :]
    handled = set(re.findall(r"display == DISPLAY_(\w+)", code))
    assert handled == {name.upper() for name in DISPLAYS} - {"RGB"}  # which is what is left
    assert not re.search(r"display == \d", code)


def test_labels_are_told_apart():
    labels = [row.label for row in DISPLAYS.values()]
    assert len(set(labels)) == len(labels)
