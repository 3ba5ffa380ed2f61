"""What the window's process keeps of memory."""

import subprocess
import sys
from pathlib import Path

import pytest

from langsplat_viewer.state import memory_bytes
from tests.viewer import memory_driver

HEAPS = """
import ctypes, sys, threading
from langsplat_viewer.jobs import share_one_heap
if sys.argv[1] == "one":
    share_one_heap()
library = ctypes.CDLL(None)
library.malloc.restype = ctypes.c_void_p
together = threading.Barrier(4)
def take():
    together.wait(30)
    library.malloc(1000)
    together.wait(30)
threads = [threading.Thread(target=take) for _ in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
library.malloc_info(0, ctypes.c_void_p.in_dll(library, "stdout"))
library.fflush(None)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of glibc")
def test_threads_share_one_heap():
    def heaps(how: str) -> int:
        said = subprocess.run([sys.executable, "-c", HEAPS, how], capture_output=True, text=True, check=True)
        return said.stdout.count("<heap nr=")

    if heaps("many") == 1:
        pytest.skip("this C library does not tell")
    assert heaps("one") == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of /proc")
def test_the_kinds_of_memory_are_all_of_it():
    kinds = memory_driver.resident()
    assert sum(kinds.values()) * 1024 == pytest.approx(memory_bytes(), rel=0.05)
    assert kinds["without a name"] > 1000


PAGED_OUT = """
import mmap, re, sys
from pathlib import Path
from langsplat_viewer.jobs import give_memory_back
def held():
    text = Path("/proc/self/smaps").read_text()
    return int(re.search(r"libLLVM-test.so[^|]*?Rss: *([0-9]+) kB", text)[1])
with open(sys.argv[1], "rb") as file, mmap.mmap(file.fileno(), 0, mmap.MAP_PRIVATE, mmap.PROT_READ) as shown:
    sum(shown[::4096])
    before = held()
    give_memory_back()
    print(before, held(), sum(shown[::4096]) == 7 * (len(shown) // 4096))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of madvise")
def test_a_compilers_code_is_given_back_and_read_again(tmp_path: Path):
    library = tmp_path / "libLLVM-test.so"
    library.write_bytes(bytes([7]) * 2**23)
    command = [sys.executable, "-c", PAGED_OUT, str(library)]
    before, after, same = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert same == "True"
    if after == before:
        pytest.skip("Linux before 5.4, or a file system that has no disk")
    assert int(after) < int(before) / 2
