"""Meshes, planes, registration, merging, maps for robots and OpenUSD stages."""

from langsplat_core.registry import Extension

_COMMANDS = "langsplat_core.extensions.geometry.commands"
EXTENSION = Extension(
    commands={
        "map": f"{_COMMANDS}:Map",
        "mesh": f"{_COMMANDS}:WriteMesh",
        "register": f"{_COMMANDS}:Register",
        "merge": f"{_COMMANDS}:Merge",
        "usd": "langsplat_core.extensions.geometry.usd:Usd",
    }
)
