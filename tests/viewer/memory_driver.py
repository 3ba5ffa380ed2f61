"""Opens the bundled scene with one answer in the real window and says what its resident memory is, in MB:

    python -m tests.viewer.memory_driver

All of it, files (libraries) by name, the rest without a name; and what of the C library's heaps is in use and
free. Linux with glibc alone; needs a display (xvfb-run).
"""

import ctypes
import threading
import time
from collections import Counter
from pathlib import Path

from langsplat_viewer import window
from langsplat_viewer.__main__ import scene_path, services
from langsplat_viewer.viewer import Viewer
from tests.viewer.resting_driver import close

SETTLE = 6.0  # seconds
SHOWN = 12  # kinds


FIELDS = ("arena", *"abc", "mapped", *"de", "used", "free", "keep")


class HeapUse(ctypes.Structure):
    """struct mallinfo2 of malloc.h, bytes."""

    _fields_ = [
        (name, ctypes.c_size_t) for name in ("arena", *"abc", "mapped", *"de", "used", "free", "keep")
    ]


class MeasuredWindow(window.Window):
    """Says what it takes as soon as the answer is there, and closes."""

    def _start(self) -> None:
        super()._start()
        threading.Thread(target=measure, args=(self.viewer,), daemon=True).start()


def measure(viewer: Viewer) -> None:
    while viewer.worker.current is not None or not any(query.result for query in viewer.state.queries):
        time.sleep(0.1)
    time.sleep(SETTLE)
    kinds = resident()
    print(f"{sum(kinds.values()) / 1024:6.0f} resident")
    print(f"{sum(resident('Pss:').values()) / 1024:6.0f} of it, if what others hold too is divided among all")
    for name, kilobytes in kinds.most_common(SHOWN):
        print(f"{kilobytes / 1024:6.0f}   {name}")
    library = ctypes.CDLL(None)
    library.mallinfo2.restype = HeapUse
    heap = library.mallinfo2()
    print(f"{(heap.used + heap.mapped) / 2**20:6.0f} in use in heaps\n{heap.free / 2**20:6.0f} free in them")
    close()


def resident(measure: str = "Rss:") -> Counter[str]:
    """kB by the name of what is mapped; measure: one of smaps."""
    found: Counter[str] = Counter()
    name = ""
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        first, *rest = line.split(maxsplit=5)
        if not first.endswith(":"):
            name = Path(rest[4]).name if len(rest) > 4 and rest[4].startswith("/") else "without a name"
        elif first == measure:
            found[name] += int(rest[0])
    return found


if __name__ == "__main__":
    window.Window = MeasuredWindow  # type: ignore[misc]
    request = window.WindowRequest(
        scene_path(None), ("teddy bear",), display="relevancy", size=(1280, 800), backend="cpu"
    )
    window.open_window(request, services(""))
