"""Results of stages, kept under a key of settings and inputs; the work folder's lock; groups of processes."""

import contextlib
import hashlib
import io
import json
import logging
import os
import socket
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.io.files import atomic_path, fcntl
from langsplat_core.io.hostile import write_npy
from langsplat_core.scene import Gaussians
from langsplat_core.semantics.features import ImageFeatures

log = logging.getLogger("langsplat")
LOCK = "in-use.lock"  # in the work folder, where it stays: only the system's lock on it counts
DIGEST = "digest"  # name beside the arrays of a stage
PATIENCE = timedelta(days=7)  # radiance training is one process's work, and the others wait for it
T = TypeVar("T")
Arrays = Mapping[str, Array]


def stage_key(name: str, version: int, *inputs: Any) -> str:
    """Return a name as ``radiance-7293f2d8d936``, another for other inputs or `version` of the code."""
    plain = [asdict(item) if is_dataclass(item) and not isinstance(item, type) else item for item in inputs]
    text = json.dumps([name, version, plain], sort_keys=True, default=str)
    return f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"


def kept(path: Path, make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays of a stage, read from `path` (*.npz) where they were made before.

    Else they are made and stored there, whole or not at all. Raises FormatError for a damaged file, and for
    one whose arrays are not those that were stored: later stages believe their shapes and numbers.
    """
    if path.exists():
        log.debug("%s: kept from an earlier run", path.name)
        found = dict(read_arrays(path))
        if str(found.pop(DIGEST, "")) != _digest(found.values()):
            raise changed(path)
        return found
    made = make()
    # The digest first, so that it is not lost together with an array at the end.
    arrays: Arrays = {DIGEST: np.array(_digest(made.values())), **made}
    with atomic_path(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)
    return made


def write_array(path: Path, array: Array) -> None:
    """Write an array of numbers that `open_array` maps, with its digest behind it, whole or not at all."""
    write_npy(path, array, bytes.fromhex(_digest([array])))


def open_array(path: Path) -> Array:
    """Map the array of `write_array` in `path` (*.npy) into memory; FormatError for a damaged file."""
    with _damage_as_error(path):
        try:
            array: Any = np.load(path, mmap_mode="r", allow_pickle=False)
        except ValueError:  # an array without elements cannot be mapped
            return np.load(path, allow_pickle=False)
        with path.open("rb") as file:
            file.seek(array.offset + array.nbytes)
            stated = file.read().hex()
    if stated != _digest([array]):
        raise changed(path)
    return np.asanyarray(array)


def read_arrays(path: Path) -> Arrays:
    """Return the arrays of an .npz file; FormatError for a damaged one."""
    # Not by `read_npz`, which takes no array of more than 2 GB, and thrice its memory.
    with _damage_as_error(path), np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
        if not arrays or not all(isinstance(array, np.ndarray) for array in arrays.values()):
            raise ValueError("it holds none, or more than arrays")
        return arrays


@contextmanager
def _damage_as_error(path: Path) -> Iterator[None]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a header of Python 2, which NumPy mends with a warning
            yield
    except Exception as error:  # noqa: BLE001  zipfile and NumPy may raise any
        raise FormatError(f"{path}: damaged ({printable_line(error, 80)}); delete it and run again") from None


def changed(path: Path) -> FormatError:
    """Return the error of a stage's file that is not as it was written."""
    return FormatError(f"{path}: changed since it was written; delete it and run again")


def digest_of(data: Gaussians | ImageFeatures) -> str:
    """Return a digest of every number of Gaussians, or of the masks and vectors of a photograph."""
    return _digest(getattr(data, entry.name) for entry in fields(data))


def _digest(arrays: Iterable[Array]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


@contextmanager
def sole_use(folder: Path) -> Iterator[None]:
    """Hold `folder` for one training, as two would write each other's stages.

    It is made if missing, and removed if nothing came into it. The lock is the operating system's and ends
    with its process; file systems without locks hold nothing. InputError where another training holds it.
    """
    if fcntl is None:  # Windows; there two trainings in one folder are the user's to avoid
        folder.mkdir(parents=True, exist_ok=True)
        yield
        return
    with _locked(folder) as file:
        with contextlib.suppress(OSError):  # a full disk is reported where something is lost by it
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        try:
            yield
        finally:
            if os.listdir(folder) == [LOCK]:
                (folder / LOCK).unlink()
                folder.rmdir()


def _locked(folder: Path) -> io.FileIO:
    """Open the lock's file, and lock it where the file system knows locks."""
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        file = io.FileIO(folder / LOCK, "a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read(80).decode(errors="replace").strip() or "a process that gives no name"
            file.close()
            instead = "wait for it, or name another one with --work"
            raise InputError(f"{folder}: {holder} trains in this folder; {instead}") from None
        except OSError:  # a file system that knows no locks
            return file
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), os.stat(folder / LOCK)):
                return file
        file.close()  # its holder has removed the file meanwhile: this lock protects nothing


@dataclass(frozen=True)
class ProcessGroup:
    """This process among those that share a training; alone by default.

    `torchrun --nproc-per-node 2 -m langsplat_core train DATASET --out scene.ply` starts two. Results go
    through the work folder, item by item, so that a lost process costs only what it had not finished.
    """

    rank: int = 0
    size: int = 1

    @property
    def is_main(self) -> bool:
        """True for the process that does the work that cannot be shared, and that prints."""
        return self.rank == 0

    def share(self, items: Sequence[T]) -> list[T]:
        """Return the part of `items` that is this process's work."""
        return list(items[self.rank :: self.size])

    def barrier(self) -> None:
        """Wait for all processes. Raises InputError where one of them has ended."""
        if self.size < 2:
            return
        import torch.distributed

        try:
            torch.distributed.barrier()
        except RuntimeError as error:
            raise InputError(
                f"another process of this training ended ({printable_line(error, 80)}); give the same "
                "command again: what is finished is kept"
            ) from None

    def once(self, make: Callable[[], T]) -> T:
        """Return the result of `make`, which keeps it in a file: one process makes it, the others read it."""
        if self.is_main:
            result = make()
            self.barrier()
            return result
        self.barrier()
        return make()


def join_processes() -> ProcessGroup:
    """Join the processes that torchrun started; a group of one without it."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size < 2:
        return ProcessGroup()
    import torch.distributed

    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group("gloo", timeout=PATIENCE)
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    return ProcessGroup(torch.distributed.get_rank(), torch.distributed.get_world_size())
