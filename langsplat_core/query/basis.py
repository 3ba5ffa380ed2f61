"""What the answers in a scene stand on, in words for people."""

from dataclasses import dataclass

from langsplat_core.scene import Calibration, LanguageField
from langsplat_core.semantics.encoders import DEMO, DEMO_ELSEWHERE


@dataclass(frozen=True)
class Basis:
    """The encoder and calibration behind the answers in a scene."""

    encoder: str  # as the scene names it
    calibration: str | None  # scenes in which probabilities were calibrated; None: there are none
    short: str  # one line
    long: str  # the same with consequences and remedy
    guesses: bool  # True for the demo encoder outside the rooms that it was made for


def basis_of(field: LanguageField, by_chance: bool, used: Calibration | None) -> Basis:
    """Return the basis of answers. by_chance: with everyday phrases; used: the calibration, also a user's."""
    name = "demo encoder" if field.encoder_id == DEMO else field.encoder_id
    guesses = field.encoder_id == DEMO and field.calibration is None
    calibration = None
    if guesses:
        short, long = f"{name}, made for drawn rooms: guesses here", DEMO_ELSEWHERE
    elif not by_chance:
        short = f"{name}, as published: no everyday phrases to compare with"
        long = f"{short}. Found is a relevancy of {field.found:g} or more, without percentages"
    elif field.calibration is not None:
        short, calibration = f"{name}, calibrated in drawn rooms", "drawn rooms"
        long = f"{short}. Percentages hold in such rooms, and this scene is one"
    elif used is not None:
        short, calibration = f"{name}, calibrated by `langsplat doctor`", "the bundled room"
        long = f"{short}, from drawn rooms: percentages hold there, and may be off in this scene"
    else:
        short = f"{name}, no calibration here: found is more than by chance"
        long = (
            f"{short}. Percentages are of phrases for nothing here that fit as well (found: up to 5); "
            "probabilities need a calibration in such scenes"
        )
    return Basis(field.encoder_id, calibration, short, long, guesses)
