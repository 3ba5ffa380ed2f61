"""Stages that remember: a result is stored under a key made of its settings and inputs."""

import hashlib
import json
from dataclasses import asdict, is_dataclass
from typing import Any


def stage_key(name: str, version: int, *inputs: Any) -> str:
    """A short name such as ``radiance-7293f2d8d936`` that changes with any setting or input.

    `inputs` are dataclasses, strings, numbers or lists of them; `version` is raised when the stage's
    code changes what it makes.
    """
    plain = [asdict(item) if is_dataclass(item) and not isinstance(item, type) else item for item in inputs]
    text = json.dumps([name, version, plain], sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
