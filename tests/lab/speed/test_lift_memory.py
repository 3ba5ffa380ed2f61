"""The memory benchmark on a size of nothing."""

import json

import pytest

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.lab.speed.lift_memory import MEANINGS, RandomEncoder, RandomViews

pytestmark = pytest.mark.long


def test_views_are_the_same_whenever_they_are_looked_at():
    views = RandomViews(3, (60, 40))
    (first, again), (_, other) = (views[1], views[1]), (views[0], views[2])
    assert (first[1].vectors == again[1].vectors).all()
    assert first[1].vectors.shape == other[1].vectors.shape
    assert first[1].vectors.shape[0] == 250 < MEANINGS
    assert len(list(views)) == 3
    assert RandomEncoder().encode_texts([]).shape == (0, 512)


def test_the_command_writes_what_it_measured(tmp_path, capsys):
    words = ["bench", "memory", "--sizes", "400", "2", "--picture", "64", "48", "--out", str(tmp_path)]
    assert main("langsplat", lambda: parse(words)) == 0
    (cost,) = json.loads((tmp_path / "memory.json").read_text())
    assert (cost["gaussians"], cost["views"]) == (400, 2)
    assert cost["kept_bytes"] > 0
    assert (tmp_path / "memory.md").read_text() in capsys.readouterr().out
    assert main("langsplat", lambda: parse([*words[:3], "0", "2"])) == 2
