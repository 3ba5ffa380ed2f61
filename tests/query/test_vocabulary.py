"""What a phrase names by its words alone."""

import pytest

from langsplat_core.query.grammar import named


@pytest.mark.parametrize(
    ("phrase", "what"),
    [
        ("", "thing"),
        ("mug", "thing"),
        ("red mug", "thing"),
        ("handle of", "thing"),
        ("handle mug", "thing"),
        ("handle", "part"),
        ("Handles", "part"),
        ("the red handle", "part"),
        ("mug handle", "part of a thing"),
        ("the red mug handles", "part of a thing"),
        ("lamp shade", "part of a thing"),
    ],
)
def test_a_part_word_at_the_end_names_a_part_and_a_thing_before_it_whose(phrase, what):
    assert named(phrase) == what
