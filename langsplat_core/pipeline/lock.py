"""One training at a time in a work folder: two would write each other's stages."""

import contextlib
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from langsplat_core.errors import InputError

try:
    import fcntl
except ImportError:  # Windows; there two trainings in one folder are the user's to avoid
    fcntl = None  # type: ignore[assignment]

LOCK = "in-use.lock"  # in the work folder; it stays there, only the system's lock on it counts


@contextmanager
def sole_use(folder: Path) -> Iterator[None]:
    """Hold `folder`, made if it is missing, for this process alone.

    The lock is the operating system's: it ends with its process, however that ends, so that none is ever left
    by a dead one. On file systems without locks nothing is held. Raises InputError where another process, or
    another training in this one, holds the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if fcntl is None:
        yield
        return
    with (folder / LOCK).open("a+b", buffering=0) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(80).decode(errors="replace").strip() or "a process that gives no name"
            raise InputError(
                f"{folder}: {holder} trains in this folder; wait for it, or name another one with --work"
            ) from None
        except OSError:  # a file system that knows no locks
            yield
            return
        with contextlib.suppress(OSError):  # a full disk is told of where something is lost by it
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield
