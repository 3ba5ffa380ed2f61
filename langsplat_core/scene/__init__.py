"""Data types of a scene: Gaussians, codecs, language fields and cameras, without devices or files."""

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
from langsplat_core.scene.scene import (
    FARTHEST,
    NO_ORIGIN,
    Camera,
    Intrinsics,
    Scene,
    about_origin,
    is_rotation,
    look_at,
    moved_pose,
    near_plane,
    origin_of,
)

__all__ = [
    "CANONICAL_PHRASES", "FARTHEST", "LEVELS", "NO_NODE", "NO_ORIGIN", "SH_COUNTS", "AutoencoderCodec",
    "Calibration", "Camera", "CodebookCodec", "Codec", "Fits", "Gaussians", "Intrinsics", "LanguageField",
    "LinearCodec", "PlattScaling", "Scene", "TaughtWord", "Tree", "about_origin", "codec_from_tensors",
    "is_rotation", "look_at", "moved_pose", "near_plane", "origin_of",
]  # fmt: skip
