"""Settings of the rooms and of the demo encoder's training; the command line is derived from them."""

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from langsplat_core.config import Count, CountOrZero, Range, Rate, Seed

Tier = Literal["separate", "clutter", "occlusion"]  # objects apart, cluttered, packed with look-alikes
TIERS: tuple[Tier, ...] = get_args(Tier)
LabelLayout = Literal["plain", "lerf-ovs", "3d-ovs"]  # how a rendered room's truth is written
Pixels = Annotated[int, Range(1, 65_536)]
Size = tuple[Pixels, Pixels]  # width and height of an image


@dataclass(frozen=True)
class EncoderConfig:
    """Training of the demo encoder."""

    rooms: Count = 400  # random rooms that crops are rendered from
    views: Count = 3  # photographs of each room
    plain_crops: CountOrZero = 8_000  # crops of nothing but a colour or a texture
    steps: Count = 8_000  # of training
    batch: Count = 128  # crops per step
    phrases: Count = 192  # phrases per step
    lr: Rate = 1e-3  # largest learning rate
    seed: Seed = 0  # of random numbers
