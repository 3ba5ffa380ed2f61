"""How coarse a picture has to be while the camera moves, learned from what pictures took."""

from dataclasses import dataclass

MOVING_BUDGET = 50.0  # milliseconds: with the panels, some fifteen pictures a second
GUESS = 5e-4  # milliseconds of a fine picture for each Gaussian, before one was drawn
MERGED_SHARE = 0.25  # of a picture's time, guessed, when four Gaussians are drawn as one
FORGET = 0.8  # what was learned is lowered by this with every fine picture, so that better is tried again


@dataclass(frozen=True)
class Level:
    """One way to draw."""

    scale: float = 1.0  # of the window's resolution
    merged: bool = False  # see `langsplat_core.scene.merging`

    @property
    def guess(self) -> float:
        """Time, as a share of a fine picture's."""
        return self.scale**2 * (MERGED_SHARE if self.merged else 1)


FINE = Level()
PLAIN = (FINE, Level(0.5), Level(0.25))
# Merged at half the resolution is nearer to the fine picture than all of it at a quarter, and cheaper.
WITH_MERGED = (FINE, Level(0.5), Level(0.5, merged=True), Level(0.25, merged=True))


class Pace:
    """Times of pictures, in milliseconds."""

    def __init__(self) -> None:
        self._count = 1
        self._each = GUESS  # of a fine picture's time, for one Gaussian
        self._shares: dict[Level, float] = {}  # of the fine picture's time, measured

    def expect(self, count: int) -> None:
        """Pictures are of so many Gaussians from now on."""
        self._count = max(count, 1)

    @property
    def is_slow(self) -> bool:
        """Whether fine pictures are too slow to follow a movement."""
        return not self._is_within(FINE)

    def drew(self, level: Level, milliseconds: float) -> None:
        """A picture took so long."""
        if level == FINE:
            self._each = milliseconds / self._count
            self._shares = {other: FORGET * share for other, share in self._shares.items()}
        elif self._each > 0:
            self._shares[level] = (self._share(level) + milliseconds / (self._each * self._count)) / 2

    def level(self, has_merged: bool) -> Level:
        """The finest at which a picture is expected within the budget, or the coarsest of all."""
        levels = WITH_MERGED if has_merged else PLAIN
        return next(filter(self._is_within, levels), levels[-1])

    def stand_in(self) -> Level | None:
        """The finest of merged Gaussians that is expected within the budget, if there is one: all of them are
        projected for few pixels, too."""
        merged = (level for level in WITH_MERGED if level.merged)
        return next(filter(self._is_within, merged), None)

    def _is_within(self, level: Level) -> bool:
        return self._each * self._count * self._share(level) <= MOVING_BUDGET

    def _share(self, level: Level) -> float:
        return 1.0 if level == FINE else self._shares.get(level, level.guess)
