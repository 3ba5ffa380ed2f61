"""Files around a scene: completion of paths, files that change, a training's checkpoints."""

import os
import shutil
import threading
from collections.abc import Callable
from contextlib import suppress
from glob import escape, glob
from itertools import islice
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from langsplat_core.errors import InputError
from langsplat_core.io.files import atomic_path, is_utf8
from langsplat_core.io.ply import write_ply
from langsplat_core.pipeline.report import PREVIEW, work_folder
from langsplat_core.scene import Gaussians

# Paths that are typed.

MOST_OFFERED = 1000


def path_completions(typed: str, folder: Path, suffixes: tuple[str, ...] = ()) -> list[str]:
    """Return the folder above, and the first folders, and files with these suffixes, that begin as typed."""
    begun = os.path.join(folder, os.path.expanduser(typed))
    above, found = os.path.dirname(os.path.normpath(begun)), glob(f"{escape(begun)}*")  # no hidden ones
    paths = ((path, os.path.isdir(path)) for path in sorted(found) if is_utf8(Path(path)))
    offered = (path + os.sep * is_dir for path, is_dir in paths if is_dir or path.lower().endswith(suffixes))
    return [os.path.join(above, ""), *islice(offered, MOST_OFFERED)]


# A scene's files that change while it is shown. A thread of its own looks about once a second, so that the
# window can sleep until there is something to say.

Stamp = tuple[int, int] | None  # time of change (ns) and bytes of a file; None where there is none
Stamps = tuple[tuple[Path, Stamp], ...]


def stamps(files: tuple[Path, ...]) -> Stamps:
    """Return the times of change and sizes of files."""
    found: list[tuple[Path, Stamp]] = []
    for file in files:
        stamp = None
        with suppress(OSError):
            stat = file.stat()
            stamp = stat.st_mtime_ns, stat.st_size
        found.append((file, stamp))
    return tuple(found)


class Watch:
    """Watches the files of one scene for changes."""

    def __init__(self, wake: Callable[[], None] = lambda: None) -> None:
        """`wake` is called on another thread when `changed` has changed."""
        self.wake = wake
        self.changed = False  # the files differ from those read, and have not changed for a while
        self._read: Stamps = ()  # as they were when they were read
        self._last: Stamps = ()  # as they were at the last look
        self._lock = threading.Lock()
        self._closed = threading.Event()

    def begin(self, read: Stamps) -> None:
        """Watch these files, the scene's own first, as they were when they were read."""
        with self._lock:
            self._read = self._last = read
            self.changed = False

    def start(self) -> None:
        threading.Thread(target=self._run, name="langsplat-watch", daemon=True).start()

    def _run(self) -> None:
        while not self._closed.wait(1.0):
            self.look()

    def look(self) -> None:
        """Compare the files with what was read; one still being written, or gone, counts as unchanged."""
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
        """Count the files as read in their present state."""
        self.begin(self._last)

    def close(self) -> None:
        self._closed.set()


# Gaussians that are still being trained: the checkpoints of `langsplat train` as scenes to look at.
#
# A checkpoint has the raw parameters as tensors ``values.*``, colours in two parts; it is read without torch.

PARTS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh_dc", "sh_rest")
IN_TRAINING = ".checkpoint.safetensors"


def newest(out: Path) -> Stamps:
    """Return the Gaussians that the training of `out` wrote last, in training or done, with their stamp.

    Empty where there are none.
    """
    folder = work_folder(out)
    found = stamps((*folder.glob(f"radiance-*{IN_TRAINING}"), *folder.glob("radiance-*.ply")))
    return tuple(sorted(found, key=lambda file: file[1] or (0, 0))[-1:])


def is_preview(path: Path | None) -> bool:
    """Return True for files that `write_preview` writes."""
    return path is not None and path.name == PREVIEW


def write_preview(checkpoint: Path) -> Path:
    """Write the Gaussians of `newest` as a scene beside them. InputError where they cannot be read."""
    path = checkpoint.with_name(PREVIEW)
    if not checkpoint.name.endswith(IN_TRAINING):
        with atomic_path(path) as temporary:
            shutil.copyfile(checkpoint, temporary)
        return path
    try:
        with safe_open(checkpoint, framework="numpy") as file:
            held = {name: file.get_tensor(f"values.{name}") for name in PARTS}
        sh = np.concatenate([held.pop("sh_dc"), held.pop("sh_rest")], 1)
        gaussians = Gaussians(**held, sh=sh)
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{checkpoint}: no Gaussians in training ({reason})") from None
    with atomic_path(path) as temporary:
        write_ply(temporary, gaussians)
    return path
