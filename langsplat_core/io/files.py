"""How files are written, whole or not at all; and checks of where none can be written."""

import errno
import json
import os
import re
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from langsplat_core.errors import InputError, LangSplatError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

NAME_MAX, PATH_MAX = 255, 4_096  # bytes, where the system does not say
LONGEST_SUFFIX = 64  # bytes of a suffix that a temporary name keeps
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # where a disk is full, or broken
# Where files are none: what is written there is read by the system or by nobody, and is gone afterwards.
_SYSTEM, _MEMORY = ("/proc", "/sys", "/dev"), "/dev/shm"
_UMASK = os.umask(0o077)
os.umask(_UMASK)  # the only way to ask is to change it


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside `path`; on a clean exit it is renamed to `path`, else removed.

    The temporary name keeps the suffix, because some writers choose the format by it. Where the disk takes no
    more, an OSError with `path` comes out, whatever the writer said.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    suffix = target.suffix if len(os.fsencode(target.suffix)) <= LONGEST_SUFFIX else ""
    handle, name = tempfile.mkstemp(prefix=".writing-", suffix=suffix, dir=target.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o666 & ~_UMASK)  # mkstemp makes private files; ours are ordinary ones
        temporary.replace(target)
    except Exception as error:
        cause = _no_room(error, temporary)
        if cause is None:
            raise
        raise OSError(cause.errno, cause.strerror, str(target)) from error
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: object) -> None:
    """Write a value as a JSON file, whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


@contextmanager
def turns(folder: Path) -> Iterator[Callable[[], None]]:
    """Yield a function that waits for a turn at the files of `folder`, which lasts to the end of the block.

    Of all who wait, in this process or others, one at a time has it; where there are no locks, all have it.
    """
    handle = -1
    if fcntl is not None:
        with suppress(OSError):  # a folder that may not be read
            handle = os.open(folder, os.O_RDONLY)

    def wait() -> None:
        if handle >= 0:
            with suppress(OSError):  # a file system that knows no locks
                fcntl.flock(handle, fcntl.LOCK_EX)

    try:
        yield wait
    finally:
        if handle >= 0:
            os.close(handle)


def _no_room(error: Exception, temporary: Path) -> OSError | None:
    """Return the system's own error where `error`, raised while writing `temporary`, comes from a full disk.

    Libraries say so in their own words and classes, or give no cause at all: then the system is asked again.
    """
    if isinstance(error, LangSplatError):
        return None
    if isinstance(error, OSError) and error.errno is not None:
        return error if error.errno in NO_ROOM else None
    said = re.search(r"\(os error (\d+)\)", str(error))  # a library in Rust, such as safetensors
    if said is not None and int(said[1]) in NO_ROOM:
        return OSError(int(said[1]), os.strerror(int(said[1])))
    try:
        with temporary.open("ab") as file:
            file.write(bytes(1 << 16))
    except OSError as found:
        return found if found.errno in NO_ROOM else None
    return None


def name_max(folder: Path) -> int:
    """Bytes that the file system of an existing `folder` takes for one name."""
    try:
        return os.pathconf(folder, "PC_NAME_MAX")
    except (AttributeError, OSError, ValueError):  # Windows has none; not every file system answers
        return NAME_MAX


def check_output_file(path: Path | str) -> None:
    """Raise InputError, in one line, where no file can be written at `path`.

    That is a name that the file system does not take, a folder, a place under a file, in the system's own
    folders, or where one may not write. Folders that are missing will be made; nothing is left behind by the
    check.
    """
    target = Path(path)
    folder = _existing_folder(target)
    try:
        mode = os.stat(target).st_mode  # once: another process may replace the file meanwhile
    except (OSError, ValueError):
        mode = stat.S_IFREG  # none there, or no name for one, which writing will say
    if stat.S_ISDIR(mode):
        raise InputError(f"{shown(path)}: is a folder; name a file in it")
    if not stat.S_ISREG(mode):
        raise InputError(f"{shown(path)}: is no ordinary file; choose another name")
    _try_writing(target, folder)


def check_output_folder(path: Path | str) -> None:
    """Raise InputError, in one line, where files cannot be written into a folder `path`.

    It may be missing yet; see `check_output_file`.
    """
    target = Path(path)
    folder = _existing_folder(target)
    if os.path.lexists(target) and not os.path.isdir(target):
        raise InputError(f"{shown(path)}: is a file; name a folder")
    _try_writing(target, folder)


def shown(path: Path | str) -> str:
    """Return a path for a message: printable, and without its middle where it is long."""
    text = str(path).encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= 100 else f"{text[:50]}...{text[-47:]}"


def _existing_folder(target: Path) -> Path:
    """Return the nearest folder above `target` that exists.

    InputError for names that it cannot hold.
    """
    try:
        size = len(str(target).encode())
    except UnicodeEncodeError:
        raise InputError(f"{shown(target)}: the name is not UTF-8; choose another") from None
    try:
        os.fsencode(target)
    except UnicodeEncodeError:
        raise InputError(
            f"{shown(target)}: names here are {sys.getfilesystemencoding()} (language settings), which lacks "
            "some of these letters; choose another name"
        ) from None
    if "\0" in str(target):
        raise InputError(f"{shown(target)!r}: no name can hold a zero byte; choose another")
    whole = Path(os.path.abspath(target))
    if size > PATH_MAX // 2:  # companions and temporary files need room too
        raise InputError(f"{shown(target)}: a path of {size} bytes; choose a shorter one")
    folder = next((above for above in whole.parents if os.path.lexists(above)), Path(whole.anchor))
    if not os.path.isdir(folder):
        raise InputError(f"{shown(target)}: {shown(folder)} is a file, not a folder; choose another name")
    longest = max(whole.relative_to(folder).parts, key=lambda part: len(part.encode()), default="")
    if len(longest.encode()) > name_max(folder):
        raise InputError(
            f"{shown(target)}: a name of {len(longest.encode())} bytes; this file system takes "
            f"{name_max(folder)}, choose a shorter one"
        )
    return folder


def _try_writing(target: Path, folder: Path) -> None:
    real = os.path.realpath(target)
    if any(_below(real, place) for place in _SYSTEM) and not _below(real, _MEMORY):
        raise InputError(f"{shown(target)}: lies in a folder of the system's own; choose another")
    try:
        with tempfile.TemporaryFile(dir=target if os.path.isdir(target) else folder):
            pass
    except OSError as error:
        raise InputError(
            f"{shown(target)}: nothing can be written into {shown(folder)} ({error.strerror}); "
            "choose another folder"
        ) from None


def _below(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + os.sep)
