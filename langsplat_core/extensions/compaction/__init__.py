"""Scenes made smaller and cleaner within an error budget."""

from langsplat_core.registry import Extension

_COMMANDS = "langsplat_core.extensions.compaction.commands"
EXTENSION = Extension(commands={"clean": f"{_COMMANDS}:Clean", "compact": f"{_COMMANDS}:Compact"})
