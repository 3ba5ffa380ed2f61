"""Fixtures of the tests of file formats."""

import shutil
import subprocess
import tracemalloc
import warnings

import pytest

MEMORY = 32 * 1024 * 1024  # bytes; the samples have at most 20 kB


@pytest.fixture
def bounded():
    """Fails the test when Python and NumPy together ever held more than MEMORY, or a warning was given."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracemalloc.start()
        yield
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < MEMORY, f"{peak / 1e6:.0f} MB"


@pytest.fixture
def put(tmp_path):
    """Writes a file with the given content and returns its path."""

    def write(content: bytes, name: str = "scene"):
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


@pytest.fixture
def splat_transform():
    """Runs @playcanvas's program of that name; the test is skipped where it is not installed."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("splat-transform of @playcanvas is not installed")
    return lambda *words: subprocess.run([program, "-w", "-q", *words], check=True, timeout=300)
