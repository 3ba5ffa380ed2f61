"""Meshes, planes, registration, merging, maps for robots and OpenUSD stages."""

from langsplat_core.registry import Extension

_COMMANDS, _USD = (f"langsplat_core.extensions.geometry.{module}" for module in ("commands", "usd"))
EXTENSION = Extension(
    commands={
        "map": f"{_COMMANDS}:Map",
        "mesh": f"{_COMMANDS}:WriteMesh",
        "register": f"{_COMMANDS}:Register",
        "merge": f"{_COMMANDS}:Merge",
    },
    formats={f".{name}": f"{_USD}:{name.upper()}" for name in ("usda", "usdc", "usd", "usdz")},
)
