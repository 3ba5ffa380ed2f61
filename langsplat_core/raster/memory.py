"""Pictures that this machine's memory cannot hold are refused before anything is allocated for them."""

import os
from functools import cache
from pathlib import Path

from langsplat_core.errors import InputError
from langsplat_core.scene import Camera

# Of a picture of colours with alpha while it is drawn and turned into display values, float32 and uint8.
BYTES_PER_PIXEL = 40
_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def check_picture(camera: Camera) -> None:
    """InputError where a picture of the camera's size needs more than all of this machine's memory."""
    needed = camera.width * camera.height * BYTES_PER_PIXEL
    if needed > memory_bytes():
        raise InputError(
            f"a picture of {camera.width}x{camera.height} pixels needs {needed / 1e9:.0f} GB of memory, and "
            f"this machine has {memory_bytes() / 1e9:.0f}; choose a smaller size"
        )


@cache
def memory_bytes() -> float:
    """What a process here may use at most: the machine's memory, or its container's share; infinite where the
    system does not say."""
    found = [float("inf")]
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        found.append(float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))
    for limit in _LIMITS:
        try:
            found.append(float(limit.read_text()))
        except (OSError, ValueError):  # not there, or "max"
            continue
    return min(found)
