"""Settings of the workshop, as frozen dataclasses; the command line is derived from them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

Tier = Literal["separate", "clutter", "occlusion"]  # objects apart, cluttered, packed with look-alikes
TIERS: tuple[Tier, ...] = get_args(Tier)
MaskOrigin = Literal["truth", "graph"]  # the outlines a perfect segmenter would find; the weight-free one's


