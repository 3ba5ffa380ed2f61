"""Machine code that is kept on disk never outlives the sources it was made from."""

import os
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path

import numba
import numpy as np
import pytest

from langsplat_core import compiled
from langsplat_core.compiled import Workers, is_compiled
from tests.support.processes import bound_by_permissions, files_of_at_most

PACKAGE = Path(compiled.__file__).parent
KERNEL = """
from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel
from langsplat_core.adding import added
@kernel
def run(first: int, last: int, out: Array) -> None:
    for i in range(first, last):
        out[i] = added(i)
"""
HELPER = (
    "from langsplat_core.compiled import helper\nSTEP = {step}\n@helper\ndef added(i):\n    return i + STEP\n"
)
CALL = "import numpy as np; from langsplat_core.running import run; x = np.zeros(3); run(0, 3, x); print(x)"


def small_package(folder: Path) -> Path:
    """A package with one kernel, whose helper in `adding.py` is still to be written."""
    package = folder / "langsplat_core"
    package.mkdir()
    (package / "__init__.py").touch()
    for name in ("arrays.py", "compiled.py", "errors.py"):
        shutil.copy(PACKAGE / name, package / name)
    (package / "running.py").write_text(KERNEL)
    return package


@pytest.mark.long
def test_kernels_are_kept_until_a_helper_changes(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(tmp_path)
    code = f"{CALL}; print(sum(run.stats.cache_misses.values()))"
    for step, said in ((1, "[1. 2. 3.]"), (5, "[5. 6. 7.]")):
        (package / "adding.py").write_text(HELPER.format(step=step))
        for misses in ("1", "0"):
            command = [sys.executable, "-c", code]
            text = subprocess.check_output(command, env=environment, cwd=tmp_path, text=True)
            assert text.splitlines() == [said, misses]
    assert len(list(package.rglob("*.nbc"))) == 1  # the code of the older sources is gone


@pytest.mark.long
@pytest.mark.parametrize("home", ["/proc", "closed"])
def test_kernels_compile_without_a_writable_folder(home: str, tmp_path: Path) -> None:
    """With neither the package's folder nor a home to write to."""
    package, closed = small_package(tmp_path), tmp_path / "closed"
    closed.mkdir()
    (package / "adding.py").write_text(HELPER.format(step=2))
    for folder in (package, closed):
        folder.chmod(0o555)
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CALL],
        env=environment | {"HOME": str(tmp_path / home)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=bound_by_permissions(),
    )
    for folder in (package, closed):
        folder.chmod(0o755)
    assert done.stdout.strip() == "[2. 3. 4.]", done.stderr
    (line,) = done.stderr.splitlines()
    assert "kernels are compiled for this run only" in line


def test_pieces_cover_a_range_once() -> None:
    def mark(first: int, last: int, out: np.ndarray) -> None:
        out[first:last] += 1

    for count, threads in product((0, 1, 7, 100), (1, 3)):
        out = np.zeros(count, int)
        Workers(threads).run(mark, count, out)
        assert (out == 1).all()


def test_kernels_run_on_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def doubled(value: float) -> float:
        return value + value

    for size in (0, 500):
        double = compiled.kernel(doubled)
        with files_of_at_most(size), caplog.at_level("WARNING", "langsplat"):
            assert double(2.5) == 5
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [
        "kernels are compiled for this run only, which takes some seconds"
    ]
    assert not list(tmp_path.rglob("*.nbc"))
    again = compiled.kernel(doubled)
    assert not is_compiled(again)
    assert again(2.5) == 5
    assert list(tmp_path.rglob("*.nbc"))
    assert is_compiled(compiled.kernel(doubled))
