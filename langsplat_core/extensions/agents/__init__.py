"""Scenes as tools for agents, by the Model Context Protocol."""

from langsplat_core.registry import Extension

EXTENSION = Extension(commands={"serve": "langsplat_core.extensions.agents.commands:Serve"})
