"""What the steps of a picture take, for those who want to know; nothing is measured for others."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import perf_counter

_laps: ContextVar[dict[str, float] | None] = ContextVar("laps", default=None)


@contextmanager
def watched() -> Iterator[dict[str, float]]:
    """Measure the laps inside, on this thread: name -> milliseconds, summed."""
    laps: dict[str, float] = {}
    before = _laps.set(laps)
    try:
        yield laps
    finally:
        _laps.reset(before)


@contextmanager
def lap(name: str, finish: Callable[[], object] = lambda: None) -> Iterator[None]:
    """One step. `finish` waits for what a device still has to do of it; called only where one watches."""
    laps = _laps.get()
    if laps is None:
        yield
        return
    began = perf_counter()
    yield
    finish()
    laps[name] = laps.get(name, 0.0) + 1e3 * (perf_counter() - began)
