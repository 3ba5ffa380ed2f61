"""The nouns of the project: plain typed data, no behaviour that needs a device or a file."""

from langsplat_core.scene.codec import AutoencoderCodec, CodebookCodec, Codec, LinearCodec, codec_from_tensors
from langsplat_core.scene.gaussians import SH_COUNTS, Gaussians
from langsplat_core.scene.language import (
    CANONICAL_PHRASES,
    LEVELS,
    NO_NODE,
    Calibration,
    Fits,
    LanguageField,
    PlattScaling,
    TaughtWord,
    Tree,
)
from langsplat_core.scene.scene import FARTHEST, Camera, Intrinsics, Scene, look_at, near_plane

__all__ = [
    "CANONICAL_PHRASES", "FARTHEST", "LEVELS", "NO_NODE", "SH_COUNTS", "AutoencoderCodec", "Calibration",
    "Camera", "CodebookCodec", "Codec", "Fits", "Gaussians", "Intrinsics", "LanguageField", "LinearCodec",
    "PlattScaling", "Scene", "TaughtWord", "Tree", "codec_from_tensors", "look_at",
    "near_plane",
]  # fmt: skip
