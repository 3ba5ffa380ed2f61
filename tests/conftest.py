"""Fixtures for every test, the option that runs the slow ones, and what tests in parallel need."""

import gc
import os
import random
import signal
import tracemalloc
import warnings
from pathlib import Path

# Before torch and BLAS are imported. Networks as small as the tests' are ten times slower on two threads than
# on one as soon as anything else wants the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import pytest

from tests.support.backends import (
    backend,
    fast_backend,
    gl,
    gl_rasterizers,
    gl_session,
    gsplat_twin,
    measured,
    print_measured,
)

__all__ = ["backend", "fast_backend", "gl", "gl_rasterizers", "gl_session", "gsplat_twin", "measured"]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--slow", action="store_true", help="run the slow tier too")
    parser.addoption("--seed", type=int, help="of the damaged files of the slow tier, in place of its own")
    parser.addoption("--shuffle", type=int, metavar="SEED", help="run tests in an order drawn with it")
    parser.addoption("--measured", action="store_true", help="print the errors that accuracy tests measured")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """`make quick` does not even import modules that are long as a whole: some take seconds to load."""
    if config.getoption("markexpr") != "not long" or collection_path.suffix != ".py":
        return None
    return "\npytestmark = pytest.mark.long" in collection_path.read_text(encoding="utf-8") or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if (seed := config.getoption("--shuffle")) is not None:
        random.Random(seed).shuffle(items)
    elif hasattr(config, "workerinput"):  # long ones first: parallel workers end at about the same time
        items.sort(key=lambda item: item.get_closest_marker("long") is None)
    if not config.getoption("--slow"):
        for item in items:
            if item.get_closest_marker("slow"):  # keywords hold the names of folders, too
                item.add_marker(pytest.mark.skip(reason="slow tier: run with --slow"))


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a shell, and children too
        signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.disable()  # what is imported stays: looking through its millions of objects is time lost
    # Chance and the clock decide nothing but in the slow tier, which looks for new cases.
    chance = config.getoption("--slow")
    hypothesis.settings.register_profile("tests", derandomize=not chance, deadline=None, database=None)
    hypothesis.settings.load_profile("tests")


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("--slow") or config.getoption("--measured"):
        print_measured(terminalreporter)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real photographs and scenes beside the repository; the test is skipped without it."""
    folder = Path(__file__).parent.parent.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data beside the repository")
    return folder


@pytest.fixture(scope="module")
def coarse_light():
    """Rooms are drawn in light of few samples."""
    from assets.making import dataset

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "LIGHT_SAMPLES", 2)
        patch.setattr(dataset, "LIGHT_CELL", 0.0)
        yield


@pytest.fixture
def bounded():
    """Fails the test when Python and NumPy together ever held more than 32 MiB, or a warning was given."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tracemalloc.start()
        yield
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 1 << 25, f"{peak / 1e6:.0f} MB"


@pytest.fixture
def put(tmp_path):
    """Writes a file with the given content and returns its path."""

    def write(content: bytes, name: str = "scene"):
        (tmp_path / name).write_bytes(content)
        return tmp_path / name

    return write
