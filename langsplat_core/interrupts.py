"""What ends a program from outside: Ctrl-C (SIGINT, exit code 130) and SIGTERM (143), each with one line.

Imports nothing that takes time, since an entry point calls `end_in_a_line` before anything else.
"""

import atexit
import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import NoReturn

SAID = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
# Modules in which nothing may be raised: LLVM drops it, numba's caller gets a SystemError, and a pool waits
# at exit for the thread that it was starting.
LATER = ("numba.", "llvmlite.", "concurrent.futures.thread")
Handler = Callable[[int, FrameType | None], object]


class Terminated(KeyboardInterrupt):
    """The system asked the process to end (SIGTERM); what was stored so far stays valid."""


def end(program: str, number: int, more: str = "") -> NoReturn:
    """End the process at once, with a line and the code of a signal."""
    with contextlib.suppress(OSError):  # a standard error that is closed or full
        os.write(2, f"{program}: {SAID[signal.Signals(number)]}{more}\n".encode())
    os._exit(128 + number)


def end_in_a_line(program: str) -> None:
    """Let signals end the process at once from now on: nothing is there to keep yet."""
    for number in SAID:
        if signal.getsignal(number) != signal.SIG_IGN:  # as a shell's background jobs have SIGINT
            signal.signal(number, lambda number, _: end(program, number))
    # Python takes back its handlers before its last steps, in which a signal would end a finished command as
    # one that was killed. What is registered first is called last.
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in SAID])


@contextlib.contextmanager
def handled(handler: Handler) -> Iterator[None]:
    """Call `handler` for both signals inside the block, unless ignored before; the main thread's alone."""
    in_main = threading.current_thread() is threading.main_thread()
    wanted = [number for number in SAID if in_main and signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, handler) for number in wanted}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, signal.SIG_DFL if old is None else old)


def raised(program: str, more: str) -> contextlib.AbstractContextManager[None]:
    """Raise KeyboardInterrupt and `Terminated` inside the block, so that what is finished is kept."""

    def stop(number: int, frame: FrameType | None) -> None:
        while frame is not None:
            # What is raised while a module is imported may be swallowed, or come out as an ImportError.
            if (module := str(frame.f_globals.get("__name__"))) == "importlib._bootstrap":
                end(program, number, more)
            if module.startswith(LATER):
                threading.Timer(0.05, signal.raise_signal, [number]).start()
                return
            frame = frame.f_back
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    return handled(stop)
