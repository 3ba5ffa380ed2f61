"""Views with masks that are read when they are needed: hundreds of label maps are more than memory wants."""

from collections.abc import Sequence
from typing import overload

from langsplat_core.scene import Camera
from langsplat_core.semantics.store import ImageFeatures


class StoredViews(Sequence[tuple[Camera, ImageFeatures]]):
    """Cameras, and the features of what each saw."""

    def __init__(self, cameras: Sequence[Camera], features: Sequence[ImageFeatures]) -> None:
        """`features`: such as `StoredFeatures`; one per camera."""
        if len(cameras) != len(features):
            raise ValueError(f"{len(cameras)} cameras, {len(features)} features")
        self._cameras, self._features = cameras, features

    def __len__(self) -> int:
        return len(self._cameras)

    @overload
    def __getitem__(self, index: int) -> tuple[Camera, ImageFeatures]: ...

    @overload
    def __getitem__(self, index: slice) -> "StoredViews": ...

    def __getitem__(self, index: int | slice) -> "tuple[Camera, ImageFeatures] | StoredViews":
        if isinstance(index, slice):
            return StoredViews(self._cameras[index], self._features[index])
        return self._cameras[index], self._features[index]
