"""Scenes made smaller and cleaner within an error budget."""

from langsplat_core.registry import Extension

_HERE = "langsplat_core.extensions.compaction"
EXTENSION = Extension(commands={"clean": f"{_HERE}.clean:Clean", "compact": f"{_HERE}.compact:Compact"})
