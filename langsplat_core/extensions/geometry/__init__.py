"""Meshes, planes, registration, merging and maps for robots."""

from langsplat_core.registry import Extension

_COMMANDS = "langsplat_core.extensions.geometry.commands"
EXTENSION = Extension(
    commands={name: f"{_COMMANDS}:{name.title()}" for name in ("map", "mesh", "register", "merge")}
)
