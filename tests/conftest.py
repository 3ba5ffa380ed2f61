"""Fixtures for every test, and the option that runs the slow ones."""

from pathlib import Path

import pytest

from tests.gl_context import gl, gl_session

__all__ = ["gl", "gl_session", "real_data"]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run the long tier too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--slow"):
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="long tier: run with --slow"))


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real photographs and scenes beside the repository; the test is skipped without it."""
    folder = Path(__file__).parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data beside the repository")
    return folder
