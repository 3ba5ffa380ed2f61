"""Laps are measured where somebody watches, and cost nothing elsewhere."""

import threading
import time

import pytest

from langsplat_core.progress import lap, watched


def test_laps_of_one_name_are_summed():
    with watched() as laps:
        for _ in range(2):
            with lap("a"):
                time.sleep(0.01)
        with lap("b"):
            pass
    assert laps["a"] >= 20
    assert laps["b"] < laps["a"]
    with lap("c"):
        pass
    assert set(laps) == {"a", "b"}


def test_a_device_is_waited_for_only_where_somebody_watches():
    waited = []
    with lap("a", lambda: waited.append(1)):
        pass
    assert waited == []
    with watched() as laps, lap("a", lambda: time.sleep(0.01)):
        pass
    assert laps["a"] >= 10


def test_other_threads_are_not_watched():
    def work() -> None:
        with lap("elsewhere"):
            pass

    with watched() as laps:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert laps == {}


def test_an_error_passes_and_the_watch_ends():
    with pytest.raises(ValueError, match="oh"), watched(), lap("a"):
        raise ValueError("oh")
    with watched() as laps:
        pass
    assert laps == {}
