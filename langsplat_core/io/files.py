"""Atomic writing of files, and checks that a path can be written."""

import errno
import json
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from langsplat_core.errors import InputError, LangSplatError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

TEMPORARY = ".writing-"  # prefix of names of temporary files
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # errors of a full or broken disk
# Names that Windows refuses or takes for a device.
_NOT_OF_WINDOWS = re.compile(r"""(?i)[<>:"|?*\0-\x1f]|[. ]$|^(con|prn|aux|nul|(com|lpt)[1-9]) *(\.|$)""")
_UMASK = os.umask(0o077)
os.umask(_UMASK)  # it can only be read by changing it


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary name beside `path`; on a clean exit it is renamed to `path`, else removed.

    The temporary name keeps the suffix, because some writers choose the format by it. A symbolic link stays
    one; a file keeps its mode, its group and, if it is writable, its hard links. If the disk is full, an
    OSError with `path` is raised, whatever the writer raised; no error names the temporary file.
    """
    target = Path(path)
    suffix = target.suffix if len(os.fsencode(target.suffix)) <= 64 else ""  # else the name may be too long
    place = Path(os.path.realpath(target)) if os.path.islink(target) else target
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, name = tempfile.mkstemp(prefix=TEMPORARY, suffix=suffix, dir=place.parent)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(target)) from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        if not (place.is_file() and place.stat().st_nlink > 1 and _filled(place, temporary)):
            _take_rights(temporary, place)
            patiently(lambda: temporary.replace(place))
    except LangSplatError as error:  # its message may have the temporary name
        error.args = tuple(str(part).replace(str(temporary), str(target)) for part in error.args)
        raise
    except Exception as error:
        cause = _no_room(error, temporary)
        if cause is None and isinstance(error, OSError) and error.errno and error.filename == name:
            cause = error
        if cause is None or getattr(error, "filename", None) not in (None, name):
            raise  # as it is; also if it names another file of those that are written together
        raise OSError(cause.errno, cause.strerror, str(target)) from error
    finally:
        with suppress(PermissionError):
            patiently(lambda: temporary.unlink(missing_ok=True))


def patiently(step: Callable[[], object]) -> object:
    """Call `step`, which replaces or removes a file, again if Windows refuses because the file is open.

    A window that reads a checkpoint of a training opens it for a moment, and so do virus scanners.
    """
    for wait in (0.05, 0.2, 0.8) if sys.platform == "win32" else ():
        with suppress(PermissionError):
            return step()
        time.sleep(wait)
    return step()


def _take_rights(temporary: Path, place: Path) -> None:
    """Give a temporary file the mode and group of the file that it replaces, or those of a new one."""
    try:
        before = place.stat()
    except OSError:
        temporary.chmod(0o666 & ~_UMASK)  # mkstemp makes private files
        return
    with suppress(OSError, AttributeError):  # another group; Windows
        os.chown(temporary, -1, before.st_gid)
    temporary.chmod(stat.S_IMODE(before.st_mode))


def _filled(place: Path, temporary: Path) -> bool:
    """Copy a file's content into `place`, which keeps its hard links; False if it is not writable."""
    try:
        file = place.open("r+b")
    except OSError:
        return False
    with file, temporary.open("rb") as source:
        size, before = os.fstat(source.fileno()).st_size, os.fstat(file.fileno()).st_size
        try:
            if size > before and hasattr(os, "posix_fallocate"):  # a full disk leaves the old content
                os.posix_fallocate(file.fileno(), 0, size)
        except OSError:
            file.truncate(before)
            raise
        shutil.copyfileobj(source, file)
        file.truncate(size)
    return True


def write_whole(path: Path | str, content: str | bytes) -> None:
    """Write a file atomically, text as UTF-8."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, content: object) -> None:
    """Write a value as a JSON file, atomically."""
    write_whole(path, json.dumps(content, indent=1) + "\n")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold an exclusive lock on `folder` within the block; systems without file locks do not wait."""
    handle = -1
    if fcntl is not None:
        with suppress(OSError):
            handle = os.open(folder, os.O_RDONLY)
            fcntl.flock(handle, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if handle >= 0:
            os.close(handle)


def _no_room(error: Exception, temporary: Path) -> OSError | None:
    """Return the system's error if writing `temporary` failed for a full disk, whatever `error` is."""
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


def check_output_file(path: Path | str) -> None:
    """Raise InputError, in one line, if no file can be written at `path`.

    The reason may be a name that the file system refuses, a folder of that name, a file in place of a parent
    folder, a folder of the system, or permissions. Missing folders are no error; the check leaves no files.
    """
    mode = _checked(Path(path))
    if stat.S_ISDIR(mode):
        raise InputError(f"{shown(path)}: is a folder; name a file in it")
    if mode and not stat.S_ISREG(mode):
        raise InputError(f"{shown(path)}: is no ordinary file; choose another name")


def check_output_folder(path: Path | str) -> None:
    """Raise InputError if files cannot be written into a folder, which need not exist yet."""
    mode = _checked(Path(path))
    if mode and not stat.S_ISDIR(mode):
        raise InputError(f"{shown(path)}: is a file; name a folder")


def is_utf8(path: Path | str) -> bool:
    """Return False for a path of bytes that are no UTF-8, which neither the window nor JSON can show."""
    return not re.search("[\\ud800-\\udfff]", str(path))


def shown(path: Path | str) -> str:
    """Return a path for a message: printable, a long one without its middle."""
    text = str(path).encode("utf-8", "backslashreplace").decode()
    return text if len(text) <= 100 else f"{text[:50]}...{text[-47:]}"


def _checked(target: Path) -> int:
    """Return the mode of what is at `target`, 0 for nothing; InputError if it cannot be written."""
    try:
        os.fsencode(target)
        str(target).encode()
        mode = _mode(target)
        whole = Path(os.path.abspath(target))
        folder = next((above for above in whole.parents if os.path.lexists(above)), Path(whole.anchor))
        for part in whole.relative_to(folder).parts:
            _mode(folder / part)  # raises if the file system refuses the name
            if sys.platform == "win32" and _NOT_OF_WINDOWS.search(part):
                raise OSError(errno.EINVAL, "no name on Windows")
    except UnicodeEncodeError:
        raise InputError(
            f"{shown(target)}: names here are {sys.getfilesystemencoding()} (language settings), which lacks "
            "some of these letters; choose another name"
        ) from None
    except ValueError:
        raise InputError(f"{shown(target)!r}: no name can hold a zero byte; choose another") from None
    except OSError as error:
        raise InputError(f"{shown(target)}: cannot be written ({error.strerror}); choose another") from None
    if not os.path.isdir(folder):
        raise InputError(f"{shown(target)}: {shown(folder)} is a file, not a folder; choose another name")
    # Files in these folders are not stored: they control the system or vanish.
    real = Path(os.path.realpath(target))
    system = any(real.is_relative_to(place) for place in ("/proc", "/sys", "/dev"))
    if system and not real.is_relative_to("/dev/shm"):
        raise InputError(f"{shown(target)}: lies in a folder of the system's own; choose another")
    if os.path.islink(target):  # writing follows links
        folder = next((above for above in real.parents if os.path.lexists(above)), folder)
    try:
        with tempfile.TemporaryFile(dir=target if stat.S_ISDIR(mode) else folder):
            return mode
    except OSError as error:
        raise InputError(
            f"{shown(target)}: nothing can be written into {shown(folder)} ({error.strerror}); "
            "choose another folder"
        ) from None


def _mode(path: Path) -> int:
    """Return the mode of what is at `path`, 0 for nothing; OSError for an impossible name."""
    with suppress(FileNotFoundError, NotADirectoryError):
        return os.stat(path).st_mode
    return 0
