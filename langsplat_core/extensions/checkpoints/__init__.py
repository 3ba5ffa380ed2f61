"""Checkpoints of other methods, read and written, weights in other layouts, and further models."""

from langsplat_core.registry import Extension

_HERE = "langsplat_core.extensions.checkpoints"
EXTENSION = Extension(
    importers={"checkpoints": f"{_HERE}.importing:IMPORTER"},
    exporters={"langsplat": f"{_HERE}.langsplat_files:EXPORTER"},
    encoders={
        name: f"{_HERE}.weight_layouts:{name.upper().replace('_', '')}"
        for name in ("siglip", "metaclip_2", "tipsv2")
    },
    segmenters=dict.fromkeys(("sam3_video", "sam3_tracker"), f"{_HERE}.weight_layouts:load_sam3"),
    layouts={"open_clip, segment_anything, sam2": f"{_HERE}.weight_layouts:converted"},
)
