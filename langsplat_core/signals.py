"""What ends a command before it has begun. Imports nothing that takes time."""

import os
import signal
from types import FrameType
from typing import NoReturn

SAID = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def end_in_a_line(program: str) -> None:
    """From now on SIGINT and SIGTERM end the process with one line and code 130 or 143: while modules are
    imported and arguments are read there is nothing to keep. A command that runs has handlers of its own."""

    def end(number: int, frame: FrameType | None) -> NoReturn:
        os.write(2, f"{program}: {SAID[signal.Signals(number)]}\n".encode())
        os._exit(128 + number)

    for number in SAID:
        if signal.getsignal(number) != signal.SIG_IGN:  # as a shell's background jobs have SIGINT
            signal.signal(number, end)
