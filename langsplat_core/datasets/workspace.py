"""Workspaces of structure from motion: folders in the work folder, filled by processes of their own.

A workspace holds small copies of the photographs (``images``), COLMAP's ``database.db`` and, in the end, the
model (``sparse``). It is named by a digest of all that it is made from, and taken up again by a later run.
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from langsplat_core.io import apart
from langsplat_core.progress import Progress

MASKS = "masks"  # in the workspace: black where no features are wanted
FAILURES = (RuntimeError, ValueError, IndexError)  # what pycolmap raises
ROOM = 64_000_000  # bytes that a step may want: 8 photographs of 8192 features take 20 MB, with the journal
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # sums of several differ from run to run

Pair = tuple[str, str]


@dataclass(frozen=True)
class CameraGroup:
    """Photographs of one size that share one camera."""

    names: tuple[str, ...]  # file names in the workspace's images folder
    model: str  # COLMAP's camera model
    params: str = ""  # its parameters, comma-separated; empty: guessed from EXIF data or the size
    side: int = 0  # longer side, pixels


def open_workspace(work: Path, inputs: object) -> Path:
    """Return ``work/sfm-<digest>`` of `inputs`, anything that JSON can hold."""
    digest = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    folder = work / f"sfm-{digest}"
    if not (folder / "sparse").is_dir():
        (folder / "images").mkdir(parents=True, exist_ok=True)
    return folder


def run_apart(function: Callable[..., Any], *arguments: Any, workspace: Path, progress: Progress) -> Any:
    """Return ``function(*arguments, progress)``, run in a process of its own, which pycolmap may end.

    Raises RuntimeError then, and OSError for whatever fails where the disk is about full.
    """
    try:
        return apart.run(function, *arguments, progress=progress, environment=ONE_THREAD)
    except (apart.AbortedError, *FAILURES) as error:
        if shutil.disk_usage(workspace).free < ROOM:
            raise disk_full(workspace) from None
        raise error if isinstance(error, FAILURES) else RuntimeError(f"it {error}") from None


def disk_full(folder: Path) -> OSError:
    """Return the error of a disk without room."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
