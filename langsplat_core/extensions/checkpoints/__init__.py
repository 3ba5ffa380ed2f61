"""Checkpoints of other methods, read and written, weights in other layouts, and the encoders of SigLIP."""

from langsplat_core.registry import Extension

_HERE = "langsplat_core.extensions.checkpoints"
EXTENSION = Extension(
    importers={"checkpoints": f"{_HERE}.convert:IMPORTER"},
    exporters={name: f"{_HERE}.convert:{name.upper()}" for name in ("langsplat", "occam")},
    encoders={"siglip": f"{_HERE}.weight_layouts:SIGLIP"},
    layouts={"open_clip, segment_anything, sam2": f"{_HERE}.weight_layouts:converted"},
)
