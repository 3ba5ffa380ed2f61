"""How the cosines of one text encoder are read, and what they say about whether a thing is there at all."""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import sigmoid

Fits = tuple[float, float, float]  # of each level, the best, see `query.chance.Scale.fit`


@dataclass(frozen=True)
class Odds:
    """A logistic function of the best fits of an answer (Platt 1999):
    ``probability = sigmoid(constant + whole * fit of whole things + finer * the better one of the finer
    levels)``, present and absent being as likely beforehand."""

    constant: float
    whole: float
    finer: float
    found: float = 0.75  # probability from which a phrase counts as found; 0.5 up to here is a weak match

    def __post_init__(self) -> None:
        slopes = (self.whole, self.finer)
        if not (np.isfinite([self.constant, *slopes]).all() and sum(slopes) > 0 and 0.5 <= self.found <= 1):
            raise ValueError(f"{self}: expected finite numbers, rising with fits, and found in [0.5, 1]")

    def probability(self, fits: Fits) -> float:
        """That what is asked for is there, in (0, 1)."""
        subpart, part, whole = fits
        logit = self.constant + self.whole * whole + self.finer * max(subpart, part)
        return float(sigmoid(np.array(logit)))


@dataclass(frozen=True)
class Calibration:
    """The odds of the three ways in which something is looked for: fits of each have another spread."""

    thing: Odds  # "mug": anything, among all that there is
    part: Odds  # "handle": a part of whatever has one
    inside: Odds  # "handle of the mug": a part, among what is on a thing that is there


@dataclass(frozen=True)
class Reading:
    """How cosines of one text encoder are read: other encoders have another scale."""

    temperature: float = 10.0  # of the softmax; 10 in the public code of LERF and LangSplat, for CLIP
    found: float = 0.6  # peak relevancy, as published, from which a phrase counts as present
    calibration: Calibration | None = None  # in drawn rooms, the only ones whose truth is known

    @property
    def elsewhere(self) -> "Reading":
        """The same for scenes other than drawn rooms: no probability is known to hold there."""
        return replace(self, calibration=None)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.temperature) and self.temperature > 0 and 0 <= self.found <= 1):
            raise ValueError(
                f"reading: temperature {self.temperature} and found {self.found}; expected a positive number "
                "and one in [0, 1]"
            )
