"""Fixtures of the tests of file formats."""

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
