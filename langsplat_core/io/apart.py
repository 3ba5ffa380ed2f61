"""A function call in a process of its own, for native libraries that abort instead of raising.

The process, a fresh interpreter, gets the function, by module and name, the arguments, pickled, the log
level, and whether a loss is an error (--strict). Progress and messages come back while it runs. It ends with
this process, even from native code that holds the interpreter lock, and at once if the work is cancelled.

A `ProcessPoolExecutor` would import the caller's ``__main__`` again, which breaks scripts without a guard,
not say how a process ended, and leave processes behind where the caller is killed.
"""

import contextlib
import logging
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from langsplat_core.errors import STRICTNESS, printable_line
from langsplat_core.progress import Progress, Report

_SERVE = "from langsplat_core.io.apart import serve; serve()"

log = logging.getLogger("langsplat")


class AbortedError(Exception):
    """The process ended without a result; the message has the signal or exit code and its last output."""


def run(
    function: Callable[..., Any],
    *arguments: Any,
    progress: Progress,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> Any:
    """Return what ``function(*arguments, progress)`` returns, or raise what it raises, in another process.

    environment: additional variables of that process. Raises AbortedError if it ends without a result. An
    exception in `progress` ends it. A frozen program, without an interpreter, calls the function itself.
    """
    if getattr(sys, "frozen", False) or not sys.executable:
        return function(*arguments, progress)
    path = {"PYTHONPATH": os.pathsep.join(folder or os.getcwd() for folder in sys.path)}
    with (
        tempfile.TemporaryFile() as printed,
        subprocess.Popen(
            [sys.executable, "-P", "-c", _SERVE],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=printed,
            env={**os.environ, **environment, **path},
            start_new_session=True,  # Ctrl-C in the terminal goes to this process alone
        ) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with contextlib.suppress(OSError):  # it has ended, which the loop below reports
                pickle.dump((log.getEffectiveLevel(), STRICTNESS.on, function, arguments), process.stdin)
                process.stdin.flush()
            while True:
                match pickle.load(process.stdout):
                    case "progress", report:
                        progress.show(Report(*report))
                    case "message", message:
                        log.log(*message)
                    case "error", error:
                        raise error
                    case _, (result, losses):
                        STRICTNESS.said.extend(losses)
                        return result
        except (EOFError, pickle.UnpicklingError):  # it ended before or within a message
            code = process.wait()
            how = signal.Signals(-code).name if code < 0 else f"code {code}"
            how += ", as where memory runs out" if how == "SIGKILL" else ""
            printed.seek(0)
            lines = [line for line in printed.read().splitlines() if line.strip()]
            last = printable_line(lines[-1].decode(errors="backslashreplace"), 300) if lines else "no message"
            raise AbortedError(f"ended with {how}: {last}") from None
        finally:
            process.kill()
            with contextlib.suppress(OSError):
                process.stdin.close()


def serve() -> None:
    """Run, in the other process, the call from standard input, and write its result to standard output."""
    given, out = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not mix with messages
    # Windows does not load a library that inspects standard input while a thread waits for it.
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    lock = threading.Lock()

    def send(kind: str, content: object) -> None:
        packed = pickle.dumps((kind, content))
        with lock:
            out.write(packed)
            out.flush()

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            send("message", (record.levelno, "%s", record.getMessage()))

    def end_with_caller() -> None:
        given.read(1)  # returns when the caller's end of the pipe is closed
        os._exit(1)

    level, STRICTNESS.on, function, arguments = pickle.load(given)
    log.addHandler(Handler())
    log.setLevel(level)
    log.propagate = False
    threading.Thread(target=end_with_caller, daemon=True).start()
    progress = Progress(lambda at: send("progress", (at.stage, at.fraction, at.note, dict(at.metrics))))
    try:
        send("result", (function(*arguments, progress), STRICTNESS.said))
    except Exception as error:  # noqa: BLE001  raised in the caller instead
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # noqa: BLE001  its class may do anything
            error = RuntimeError(f"{type(error).__name__}: {error}")
        send("error", error)
    os._exit(0)  # without joining the thread that waits for input
