"""What ends a command before it has begun, and after it is over. Imports nothing that takes time."""

import atexit
import contextlib
import os
import signal
from types import FrameType
from typing import NoReturn

SAID = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def end_in_a_line(program: str) -> None:
    """From now on SIGINT and SIGTERM end the process with one line and code 130 or 143: while modules are
    imported and arguments are read there is nothing to keep. A command that runs has handlers of its own."""

    for number in SAID:
        if signal.getsignal(number) != signal.SIG_IGN:  # as a shell's background jobs have SIGINT
            signal.signal(number, lambda number, _: end(program, number))
    # Python takes back its handlers before its last steps, in which a signal would end a finished command as
    # one that was killed. What is registered first is called last.
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in SAID])


def end(program: str, number: int, more: str = "") -> NoReturn:
    """End the process at once, with a line and the code of a signal."""
    with contextlib.suppress(OSError):  # a standard error that is closed or full
        os.write(2, f"{program}: {SAID[signal.Signals(number)]}{more}\n".encode())
    os._exit(128 + number)


def is_import(frame: FrameType | None) -> bool:
    """Whether a module is being imported where a signal came. What its handler raises there may be swallowed,
    or come out as an ImportError of some library."""
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None
