"""Fixtures for every test, and the option that runs the slow ones."""

from pathlib import Path

import pytest

from tests.support.backends import backend, fast_backend, gl_rasterizers
from tests.support.gl_context import gl, gl_session
from tests.support.measured import measured, print_measured

__all__ = ["backend", "fast_backend", "gl", "gl_rasterizers", "gl_session", "measured", "real_data"]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run the long tier too")
    parser.addoption("--measured", action="store_true", help="print the errors that accuracy tests measured")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not config.getoption("--slow"):
        for item in items:
            if "slow" in item.keywords:
                item.add_marker(pytest.mark.skip(reason="long tier: run with --slow"))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("--slow") or config.getoption("--measured"):
        print_measured(terminalreporter, config)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real photographs and scenes beside the repository; the test is skipped without it."""
    folder = Path(__file__).parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data beside the repository")
    return folder
