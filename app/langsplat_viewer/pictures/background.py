"""The fine picture of a large scene, rasterized on a thread of its own."""

from collections.abc import Callable

from langsplat_core.errors import BackendError
from langsplat_core.progress import Progress
from langsplat_core.stopwatch import watched
from langsplat_viewer.drawing.renderer import Rasterized, Rasterizing
from langsplat_viewer.jobs import Worker


class Background:
    """Rasterizes one picture at a time: what is wanted now. What comes of others is dropped."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """`clock` in seconds."""
        self.worker = Worker()
        self._clock = clock
        self._wanted: Rasterizing | None = None
        self._made: Rasterized | None = None
        self._problem = ""

    @property
    def waits(self) -> bool:
        """Whether something is wanted that has not been taken yet."""
        return self._wanted is not None

    def get(self, wanted: Rasterizing) -> Rasterized | None:
        """What came of it, once; None while it is being made, which this begins. Raises BackendError, once,
        where it failed."""
        if wanted != self._wanted:
            self.drop()
            self._wanted = wanted
            self.worker.submit("", self._work(wanted), self._keep, self._say)
        self.worker.poll()
        made, problem = self._made, self._problem
        if made is not None or problem:
            self.drop()
        if problem:
            raise BackendError(problem)
        return made

    def drop(self) -> None:
        """Nothing is wanted any more."""
        self.worker.cancel()
        self.worker.poll()  # so that nothing of a job that was left is held
        self._wanted, self._made, self._problem = None, None, ""

    def _work(self, wanted: Rasterizing) -> Callable[[Progress], Rasterized]:
        def work(report: Progress) -> Rasterized:
            began = self._clock()
            with watched() as laps:
                finish = wanted.work(report)
            return Rasterized(wanted, finish, 1e3 * (self._clock() - began), laps)

        return work

    def _keep(self, made: Rasterized) -> None:
        self._made = made

    def _say(self, problem: str) -> None:
        self._problem = problem
