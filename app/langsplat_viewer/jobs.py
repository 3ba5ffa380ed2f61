"""The worker thread of the window, and the memory that its process gives back on Linux."""

import ctypes
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any, TypeVar

from langsplat_core.errors import LangSplatError
from langsplat_core.interrupts import handled
from langsplat_core.progress import Progress, Report, WorkCancelledError

_ARENA_MAX = -8  # M_ARENA_MAX of malloc.h


def share_one_heap() -> None:
    """Have threads that begin after this allocate from one heap, where the C library allows it.

    With a heap each, all of them keep the memory that they have freed.
    """
    _in_c_library("mallopt", _ARENA_MAX, 1)


def give_memory_back() -> None:
    """Return freed memory that the C library keeps to the system: tens of megabytes after reading a scene."""
    _in_c_library("malloc_trim", 0)


def _in_c_library(name: str, *arguments: object) -> None:
    if sys.platform == "linux":
        function = getattr(ctypes.CDLL(None), name, None)  # not every C library has them
        if function is not None:
            function(*arguments)


@contextmanager
def on_signals(wake: Callable[[], None]) -> Iterator[list[int]]:
    """Keep Ctrl + C and SIGTERM from interrupting anything within.

    Their numbers are added to the list that is yielded, and `wake` is called on another thread, since
    Python's handlers run only once a sleeping main thread is awake again.
    """
    caught: list[int] = []
    reader, writer = socket.socketpair()
    writer.setblocking(False)

    def listen() -> None:
        while reader.recv(1):
            wake()

    old = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=listen, name="langsplat-signals", daemon=True).start()
    try:
        with handled(lambda number, frame: caught.append(number)):
            yield caught
    finally:
        signal.set_wakeup_fd(old)
        writer.close()


T = TypeVar("T")


REPORT_EVERY = 0.1  # seconds between reports that are worth a new frame


@dataclass(eq=False)
class Job:
    """One piece of work, waiting, running or done."""

    label: str
    done: Callable[[Any], None]
    failed: Callable[[str], None]
    work: Callable[[Progress], Any]
    wake: Callable[[], None]
    future: Future[Any] = field(default_factory=Future)
    reached: Report = field(default=Report("", 0.0))
    stopped: threading.Event = field(default_factory=threading.Event)
    reported: float = 0.0  # when, seconds

    def report(self, report: Report) -> None:
        """Take a report of the work; raises WorkCancelledError once the job is cancelled."""
        if self.stopped.is_set():
            raise WorkCancelledError
        self.reached = report
        now = time.monotonic()
        if now - self.reported >= REPORT_EVERY:
            self.reported = now
            self.wake()

    def run(self) -> None:
        if not self.future.set_running_or_notify_cancel():
            return
        try:
            self.future.set_result(self.work(Progress(self.report)))
        except BaseException as error:  # noqa: BLE001  whatever it is, the window's thread says it
            self.future.set_exception(error)
        self.wake()


class Worker:
    """Runs jobs one after the other, on a thread that ends with the process whatever it is doing."""

    def __init__(self, wake: Callable[[], None] = lambda: None) -> None:
        """`wake` is called on the worker's thread when there is something new to show."""
        self.wake = wake
        self.delivered = 0  # jobs whose outcome was handed over
        self._waiting: SimpleQueue[Job | None] = SimpleQueue()
        self._thread: threading.Thread | None = None
        self._jobs: list[Job] = []

    def submit(
        self,
        label: str,
        work: Callable[[Progress], T],
        done: Callable[[T], None],
        failed: Callable[[str], None],
    ) -> Job:
        """Queue `work`; `poll` will later call `done` with its result, or `failed` with one line."""
        job = Job(label, done, failed, work, lambda: self.wake())
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="langsplat-worker", daemon=True)
            self._thread.start()
        self._jobs.append(job)
        self._waiting.put(job)
        return job

    def _run(self) -> None:
        while (job := self._waiting.get()) is not None:
            job.run()
            del job  # and with it what it has found, however long the next one takes to come
            give_memory_back()

    def poll(self) -> None:
        """Call `done` or `failed` of what has finished, in the order of submission; once per frame."""
        finished = [job for job in self._jobs if job.future.done()]
        self._jobs = [job for job in self._jobs if job not in finished]
        for job in finished:
            self.delivered += 1
            if job.stopped.is_set() or job.future.cancelled():
                continue
            if (error := job.future.exception()) is None:
                job.done(job.future.result())
            else:
                job.failed(one_line(error))

    def cancel(self, waiting: bool = True) -> None:
        """Stop the present job where it next reports progress; with `waiting`, drop all behind it, too."""
        present = next((job for job in self._jobs if not (job.stopped.is_set() or job.future.done())), None)
        for job in self._jobs:
            if waiting or job is present:
                job.stopped.set()
                job.future.cancel()

    @property
    def current(self) -> tuple[str, float] | None:
        """Label and fraction of the present job, for the status line; None when idle or being cancelled."""
        job = next((job for job in self._jobs if not job.stopped.is_set()), None)
        return None if job is None else (job.reached.text or job.label, job.reached.fraction)

    @property
    def is_running(self) -> bool:
        """True while some job has not come to its end, cancelled or not."""
        return any(not job.future.done() for job in self._jobs)

    def close(self, patience: float = 0.0) -> None:
        """Cancel all jobs and accept no further ones.

        A job that runs has `patience` seconds to tidy up after itself, else it ends with the process.
        """
        self.cancel()
        self._waiting.put(None)
        if self._thread is not None and patience > 0:
            self._thread.join(patience)


def one_line(error: BaseException) -> str:
    """Return an error as one line for a person.

    A class that no user causes is named, so that it can be reported.
    """
    text = " ".join(str(error).split())
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, LangSplatError | OSError):
        return text or type(error).__name__
    if isinstance(error, MemoryError):
        return "not enough memory; close other programs or use a smaller scene"
    return f"internal error: {type(error).__name__}: {text}"
