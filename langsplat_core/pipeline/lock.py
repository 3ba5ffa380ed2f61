"""One training at a time in a work folder: two would write each other's stages."""

import contextlib
import io
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

LOCK = "in-use.lock"  # in the work folder, where it stays: only the system's lock on it counts


@contextmanager
def sole_use(folder: Path) -> Iterator[None]:
    """Hold `folder`, made if it is missing, for this process alone; removed again if nothing came into it.

    The lock is the operating system's: it ends with its process, however that ends, so that none is ever left
    by a dead one. On file systems without locks nothing is held. Raises InputError where another process, or
    another training in this one, holds the folder.
    """
    if fcntl is None:
        folder.mkdir(parents=True, exist_ok=True)
        yield
        return
    with _locked(folder) as file:
        with contextlib.suppress(OSError):  # a full disk is told of where something is lost by it
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        try:
            yield
        finally:
            if os.listdir(folder) == [LOCK]:
                (folder / LOCK).unlink()
                folder.rmdir()


def _locked(folder: Path) -> io.FileIO:
    """The lock's file, opened, and locked where the file system knows locks."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        file = io.FileIO(folder / LOCK, "a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(80).decode(errors="replace").strip() or "a process that gives no name"
            file.close()
            raise InputError(
                f"{folder}: {holder} trains in this folder; wait for it, or name another one with --work"
            ) from None
        except OSError:  # a file system that knows no locks
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), os.stat(folder / LOCK)):
                return file
        file.close()  # who held it has removed it meanwhile: this is a lock on nothing
