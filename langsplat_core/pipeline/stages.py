"""Stages that remember: a result is stored under a key made of its settings and inputs."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, is_dataclass
from typing import Any

from langsplat_core.datasets.capture import Capture


def stage_key(name: str, version: int, *inputs: Any) -> str:
    """A short name such as ``radiance-7293f2d8d936`` that changes with any setting or input.

    `inputs` are dataclasses, strings, numbers or lists of them; `version` is raised when the stage's
    code changes what it makes.
    """
    plain = [asdict(item) if is_dataclass(item) and not isinstance(item, type) else item for item in inputs]
    text = json.dumps([name, version, plain], sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def capture_digest(capture: Capture, indices: Sequence[int]) -> str:
    """A digest of the photographs at `indices`, their cameras and the points: all that training sees.

    Structure from motion run again may place the same photographs in another world frame, so names alone
    do not identify a capture.
    """
    digest = hashlib.sha256()
    for i in indices:
        camera = capture.cameras[i]
        intrinsics = (camera.name, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        digest.update(repr(intrinsics).encode())
        digest.update(camera.world_to_camera.tobytes())
        digest.update(capture.images[i].tobytes())
    digest.update(capture.points.tobytes())
    return digest.hexdigest()
