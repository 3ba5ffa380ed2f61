"""A function in a process of its own, for native libraries that abort where they should raise.

The process is a fresh interpreter, which knows nothing of this one but what it is given: the function, named
by its module, and arguments, which are pickled. Progress and messages come back while it runs. It ends with
this process, however that ends, and at once where the work is cancelled.
"""

import contextlib
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import IO, Any

from langsplat_core.errors import printable_line
from langsplat_core.progress import Progress, Report

SAID = 20  # last lines of standard error that are kept
_SERVE = "from langsplat_core.io.apart import serve; serve()"

log = logging.getLogger("langsplat")


class AbortedError(Exception):
    """The process ended without a result; the message is how, and the last it said."""


def run(function: Callable[..., Any], *arguments: Any, progress: Progress) -> Any:
    """``function(*arguments, progress)`` in a process of its own: what it returns, or raises; AbortedError
    where the process ended before. What `progress` raises ends the process. Where programs are frozen into
    one folder there is no interpreter to start, and the function runs here."""
    if getattr(sys, "frozen", False) or not sys.executable:
        return function(*arguments, progress)
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _SERVE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
        start_new_session=True,  # Ctrl-C in the terminal is ours
    )
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    said: deque[str] = deque(maxlen=SAID)
    listener = threading.Thread(target=_listen, args=(process.stderr, said), daemon=True)
    listener.start()
    try:
        pickle.dump((log.getEffectiveLevel(), function, arguments), process.stdin)
        process.stdin.flush()
        return _result(process.stdout, progress)
    except (EOFError, pickle.UnpicklingError, BrokenPipeError):  # it ended within or before a message
        code = process.wait()
        listener.join()
        last = next((line for line in reversed(said) if line), "it said nothing")
        raise AbortedError(f"ended with {_named(code)}: {last}") from None
    finally:
        process.kill()
        process.wait()
        listener.join()
        for pipe in (process.stdin, process.stdout, process.stderr):
            with contextlib.suppress(BrokenPipeError):
                pipe.close()


def _named(code: int) -> str:
    if code == -signal.SIGKILL:
        return "SIGKILL, as where memory runs out"
    return signal.Signals(-code).name if code < 0 else f"code {code}"


def _listen(errors: IO[bytes], said: deque[str]) -> None:
    for line in errors:
        said.append(printable_line(line.decode(errors="backslashreplace"), 300))


def _result(messages: IO[bytes], progress: Progress) -> Any:
    """Pass on what comes until the function has returned or raised."""
    while True:
        kind, content = pickle.load(messages)
        if kind == "progress":
            progress.show(Report(*content))
        elif kind == "message":
            log.log(*content)
        elif kind == "error":
            raise content
        else:
            return content


def serve() -> None:
    """The other process: run what standard input brings, and write what comes of it to standard output."""
    given = sys.stdin.buffer
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no message
    lock = threading.Lock()

    def send(kind: str, content: object) -> None:
        packed = pickle.dumps((kind, content))
        with lock:
            out.write(packed)
            out.flush()

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            send("message", (record.levelno, "%s", record.getMessage()))

    level, function, arguments = pickle.load(given)
    log.addHandler(Handler())
    log.setLevel(level)
    log.propagate = False
    threading.Thread(target=_end_with, args=(given,), daemon=True).start()
    progress = Progress(lambda at: send("progress", (at.stage, at.fraction, at.note, dict(at.metrics))))
    try:
        send("result", function(*arguments, progress))
    except Exception as error:  # noqa: BLE001  raised there instead
        send("error", _portable(error))
    os._exit(0)  # not past the thread that waits for input


def _portable(error: Exception) -> Exception:
    """The error, or where it cannot be pickled one that says the same."""
    try:
        return pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001  whatever its class does
        return RuntimeError(f"{type(error).__name__}: {error}")


def _end_with(given: IO[bytes]) -> None:
    """End this process with the one that started it: its end of the pipe closes."""
    given.read(1)
    os._exit(1)
