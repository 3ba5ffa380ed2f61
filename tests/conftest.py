"""Fixtures for every test."""

from pathlib import Path

import pytest

from tests.gl_context import gl, gl_session

__all__ = ["gl", "gl_session", "real_data"]


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real photographs and scenes beside the repository; the test is skipped without it."""
    folder = Path(__file__).parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data beside the repository")
    return folder
