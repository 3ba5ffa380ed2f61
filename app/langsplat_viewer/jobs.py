"""One worker thread, so that the window stays alive while a scene loads or a text encoder is imported.

Work is submitted from the window's thread and its outcome is handed back there by `poll`: no other module
needs to know about threads.
"""

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

from langsplat_core.errors import LangSplatError
from langsplat_core.progress import Cancelled, Progress

T = TypeVar("T")


@dataclass(eq=False)
class Job:
    """One piece of work, waiting, running or done."""

    label: str
    done: Callable[[Any], None]
    failed: Callable[[str], None]
    future: Future[Any] | None = None
    step: tuple[str, float] = ("", 0.0)  # what it last reported, fraction in [0, 1]
    stopped: threading.Event = field(default_factory=threading.Event)

    def report(self, label: str, fraction: float) -> None:
        """The `Progress` given to the work; raises Cancelled once the job is cancelled."""
        if self.stopped.is_set():
            raise Cancelled
        self.step = (label, fraction)


class Worker:
    """Runs jobs one after the other."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="langsplat-worker")
        self._jobs: list[Job] = []

    def submit(
        self,
        label: str,
        work: Callable[[Progress], T],
        done: Callable[[T], None],
        failed: Callable[[str], None],
    ) -> Job:
        """Queue `work`; `poll` will later call `done` with its result, or `failed` with one line."""
        job = Job(label, done, failed)
        job.future = self._pool.submit(work, job.report)
        self._jobs.append(job)
        return job

    def poll(self) -> None:
        """Deliver what has finished, in the order of submission. Call once per frame."""
        finished = [job for job in self._jobs if job.future is not None and job.future.done()]
        self._jobs = [job for job in self._jobs if job not in finished]
        for job in finished:
            deliver(job)

    def cancel(self) -> None:
        """Drop everything queued and stop the running job where it next reports progress."""
        for job in self._jobs:
            job.stopped.set()
            if job.future is not None:
                job.future.cancel()

    @property
    def current(self) -> tuple[str, float] | None:
        """What is being done and how far it is, for the status line; None when idle or only winding up."""
        for job in self._jobs:
            if not job.stopped.is_set():
                label, fraction = job.step
                return label or job.label, fraction
        return None

    def close(self) -> None:
        """Stop taking work; a job that runs ends by itself."""
        self.cancel()
        self._pool.shutdown(wait=False, cancel_futures=True)


def deliver(job: Job) -> None:
    """Call the right callback of a finished job; a cancelled one gets none."""
    if job.stopped.is_set() or job.future is None:
        return
    try:
        error = job.future.exception()
    except CancelledError:
        return
    if error is None:
        job.done(job.future.result())
    else:
        job.failed(one_line(error))


def one_line(error: BaseException) -> str:
    """An error as one line for a person; a class that no user causes is named, so that it can be reported."""
    text = " ".join(str(error).split())
    if isinstance(error, LangSplatError):
        return text
    if isinstance(error, MemoryError):
        return "not enough memory; close other programs or use a smaller scene"
    if isinstance(error, OSError):
        return text or type(error).__name__
    return f"internal error: {type(error).__name__}: {text}"
