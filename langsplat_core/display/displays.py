"""What can be shown: one table, one row per display.

The panel's buttons and keys, the arguments, the channels that are rasterized, and the numbers by which the
composite shader tells displays apart all come from here; the names are those of `config.Display`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from langsplat_core.config import Display

Extra = Literal["none", "latent", "relevancies", "depth"]  # what is rasterized beside colours and alpha


@dataclass(frozen=True)
class DisplayRow:
    """One display."""

    name: Display
    label: str  # on its button
    extra: Extra = "none"  # the further channel that it shows
    needs_field: bool = False  # shows the language field
    needs_query: bool = False  # shows answers


_ROWS = (
    DisplayRow("rgb", "Colours"),
    DisplayRow("depth", "Depth", "depth"),
    DisplayRow("alpha", "Alpha"),
    DisplayRow("relevancy", "Relevancy", "relevancies", needs_field=True, needs_query=True),
    DisplayRow("segmentation", "Segmentation", "relevancies", needs_field=True, needs_query=True),
    DisplayRow("latent", "Latent", "latent", needs_field=True),
)
DISPLAYS: Mapping[Display, DisplayRow] = MappingProxyType({row.name: row for row in _ROWS})  # in this order
NUMBERS: Mapping[Display, int] = MappingProxyType({name: number for number, name in enumerate(DISPLAYS)})
