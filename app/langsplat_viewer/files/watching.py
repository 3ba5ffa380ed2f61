"""Whether the files of the scene that is shown are others than when they were read. No window here.

A thread of its own looks about once a second, so that the window can sleep until there is something to say.
"""

import threading
from collections.abc import Callable
from pathlib import Path

EVERY = 1.0  # seconds between looks

Stamp = tuple[int, int] | None  # time of change (ns) and bytes of a file; None where there is none
Stamps = tuple[tuple[Path, Stamp], ...]


def stamps(files: tuple[Path, ...]) -> Stamps:
    """How `files` are now."""
    return tuple((file, _stamp(file)) for file in files)


def _stamp(file: Path) -> Stamp:
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


class Watch:
    """Looks after the files of one scene."""

    def __init__(self, wake: Callable[[], None] = lambda: None) -> None:
        """`wake` is called on another thread when `changed` has become another."""
        self.wake = wake
        self.changed = False  # the files are others than those read, and have been still for a while
        self._read: Stamps = ()  # as they were when they were read
        self._last: Stamps = ()  # as they were at the last look
        self._lock = threading.Lock()
        self._closed = threading.Event()

    def begin(self, read: Stamps) -> None:
        """Look after these files, the scene's own first, from the moment that they were read."""
        with self._lock:
            self._read = self._last = read
            self.changed = False

    def start(self) -> None:
        """Look every second from now on."""
        threading.Thread(target=self._run, name="langsplat-watch", daemon=True).start()

    def _run(self) -> None:
        while not self._closed.wait(EVERY):
            self.look()

    def look(self) -> None:
        """One look. What still changes is not spoken of, nor a scene whose own file is gone."""
        with self._lock:
            watched, last = self._read, self._last
        now = stamps(tuple(file for file, _ in watched))
        with self._lock:
            if self._read is not watched:  # another scene meanwhile
                return
            before, self._last = self.changed, now
            if now == last:
                self.changed = bool(now) and now != watched and now[0][1] is not None
            news = self.changed != before
        if news:
            self.wake()

    def dismiss(self) -> None:
        """What lies there now is not spoken of again."""
        with self._lock:
            self._read = self._last
            self.changed = False

    def close(self) -> None:
        """Look no more."""
        self._closed.set()
