"""Meshes, planes, registration, merging and maps for robots."""

from langsplat_core.registry import Extension

_COMMANDS = "langsplat_core.extensions.geometry.commands"
EXTENSION = Extension(
    commands={
        "map": f"{_COMMANDS}:Map",
        "mesh": f"{_COMMANDS}:WriteMesh",
        "register": f"{_COMMANDS}:Register",
        "merge": f"{_COMMANDS}:Merge",
    }
)
