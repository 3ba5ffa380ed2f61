"""Names and inventories against the truth of a room."""

import numpy as np
import pytest

from assets.making.truth import Region
from langsplat_core.errors import InputError
from langsplat_core.lab.config import WordBenchConfig
from langsplat_core.lab.rooms.word_bench import (
    InventoryScore,
    LevelNames,
    RoomWords,
    measure_words,
    score_inventory,
    word_table,
)
from langsplat_core.query.describe import Entry, Spot

TRUTH = {
    0: Region("whole", "mug", "mug", words=("mug", "cup", "red mug")),
    1: Region("whole", "table", "table", words=("table",)),
    2: Region("whole", "duck", "duck", words=("duck",)),
}
LABELS = np.stack([np.repeat([-1, -1, -1, -1], 30), np.repeat([-1] * 4, 30), np.repeat([0, 1, 2, -1], 30)])


def entry(phrase: str, rows: range, level: int = 2) -> Entry:
    spot = Spot(np.zeros(3), np.zeros((2, 3)), np.array(rows), 0.1, None, None)
    return Entry(phrase, (), level, 0.9, 0.9, 0.1, (spot,))


def test_an_entry_is_true_where_most_of_its_surface_is():
    entries = [
        entry("cup", range(35)),  # the mug, and a little of the table
        entry("duck", range(50, 70)),  # half the table
        entry("lamp", range(60, 90)),  # the duck
        entry("table", range(30, 60), level=1),  # no whole thing
    ]
    score = score_inventory(entries, LABELS, TRUTH, np.ones(120), ["cup", "duck", "table"])
    assert score == InventoryScore(entries=3, true=1 / 3, things=3, named=1 / 3, seconds=0.0)


def test_things_without_a_word_in_the_vocabulary_do_not_count():
    areas = np.ones(120)
    areas[:30] = 10
    score = score_inventory([entry("mug", range(60))], LABELS, TRUTH, areas, ["mug"])
    assert (score.true, score.things, score.named) == (1, 1, 1)
    assert score_inventory([], LABELS, TRUTH, areas, []).named == 0


def test_the_table_has_a_row_for_each_figure():
    names = (LevelNames("plain cosine", "whole", 30, 0.5, 0.9, 0.7, 0.6),)
    text = word_table([RoomWords(7, names, 0.93, InventoryScore(20, 0.8, 25, 0.6, 1.25))])
    assert "| 7 | plain cosine | whole | 30 | 50 | 90 | 0.70 | 0.60 |" in text
    assert "| 7 | 20 | 80 | 25 | 60 | 93 | 1.2 |" in text


def test_no_room(tmp_path):
    with pytest.raises(InputError, match="--seeds"):
        measure_words(WordBenchConfig(seeds=()), tmp_path)
