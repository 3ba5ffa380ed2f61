"""What a worker of the parallel tests needs of its own."""

import os
import shutil
import sys
from pathlib import Path

import langsplat_core

COMPILED = Path(langsplat_core.__file__).parent / "__pycache__"


def own_kernel_cache() -> None:
    """Give this process, if it is a worker, compiled kernels of its own, beginning with what others compiled.

    numba's index of compiled code knows no locks: processes that compile at once may mix up their files.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is None or "NUMBA_CACHE_DIR" in os.environ:
        return
    assert "numba" not in sys.modules  # it reads the environment when imported
    shared, own = COMPILED / "kernels", COMPILED / f"kernels-{worker}"
    for folder in shared.glob("*/*"):  # kernel's file / digest of its sources
        if not (own / folder.relative_to(shared)).exists():
            shutil.copytree(folder, own / folder.relative_to(shared))
    os.environ["NUMBA_CACHE_DIR"] = str(own)
