"""Letters beyond Latin."""

import pytest
from matplotlib.ft2font import FT2Font

from langsplat_viewer import fonts


def test_the_first_fallback_has_the_scripts_that_it_is_there_for():
    letters = FT2Font(fonts.fallbacks()[0]).get_charmap()
    for text in ("жук", "κούπα", "čaj żółć", "ספל", "كوب", "→ ≥ ✓"):
        assert all(ord(letter) in letters for letter in text if letter != " "), text


def test_a_font_of_the_system_with_more_scripts_is_taken(tmp_path, monkeypatch):
    monkeypatch.setattr(fonts, "FOLDERS", {fonts.sys.platform: (str(tmp_path),)})
    assert len(fonts.fallbacks()) == 1
    for name in ("other.ttf", "wqy-zenhei.ttc", "NotoSansCJK-Regular.ttc"):
        (tmp_path / name).write_bytes(b"")
    assert fonts.fallbacks()[1].name == "NotoSansCJK-Regular.ttc"


@pytest.mark.parametrize("platform", ["linux", "darwin", "win32", "emscripten"])
def test_a_system_without_fonts_is_no_error(monkeypatch, platform):
    monkeypatch.setattr(fonts.sys, "platform", platform)
    monkeypatch.setattr(fonts, "FOLDERS", {})
    assert [path.name for path in fonts.fallbacks()] == [fonts.PLAIN]
