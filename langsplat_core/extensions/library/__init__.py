"""Search over all scenes of a folder, and changes between two scenes of one place."""

from langsplat_core.registry import Extension

_HERE = "langsplat_core.extensions.library"
EXTENSION = Extension(
    commands={name: f"{_HERE}.commands:{name.title()}" for name in ("find", "changes")},
    panels={"Library": f"{_HERE}.panel:PANEL"},
)
