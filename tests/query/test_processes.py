"""Questions and pictures from processes that were forked or spawned, and from many threads at once."""

import multiprocessing
import os
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import cache

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.render import render
from tests.support.fakes import WORDS, FakeEncoder, blob_scene
from tests.support.scenes import random_camera, random_gaussians

pytestmark = pytest.mark.long
THREADS = 12


class OneAtATime(FakeEncoder):
    """Fails, as tokenizers do, where two threads ask at once."""

    made = 0

    def __init__(self) -> None:
        OneAtATime.made += 1
        self.busy = False

    def encode_texts(self, texts: list[str]) -> Array:
        assert not self.busy
        self.busy = True
        time.sleep(0.01)
        found = super().encode_texts(texts)
        self.busy = False
        return found


@cache  # in a forked process these are the parent's
def engine() -> QueryEngine:
    return QueryEngine(blob_scene(), lambda _: OneAtATime())


@cache
def rasterizer() -> CpuRasterizer:
    return CpuRasterizer(threads=3)


def answers(_: int = 0) -> tuple[list[Array], Array, Array]:
    """Relevancies of every word, a picture, and one by a rasterizer with three threads."""
    asked = [engine().run(word).relevancy for word in WORDS]
    camera = random_camera(3, 60, 40)
    view = rasterizer().view(random_gaussians(200, 4), camera)
    return asked, render(blob_scene(), blob_scene().cameras[0]).colours, view.splat(np.ones((200, 2)))[0]


def check_equal(found: tuple[list[Array], Array, Array], wanted: tuple[list[Array], Array, Array]) -> None:
    for ours, theirs in zip([*found[0], *found[1:]], [*wanted[0], *wanted[1:]], strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("how", ["fork", "spawn", "forkserver"])
def test_a_child_gives_its_parents_answers(how: str) -> None:
    if how not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {how} on this system")
    wanted = answers()  # with its threads begun, of which a fork takes none along
    with ProcessPoolExecutor(2, multiprocessing.get_context(how)) as pool:
        found = [future.result() for future in [pool.submit(answers) for _ in range(3)]]
    for one in found:
        check_equal(one, wanted)
    check_equal(answers(), wanted)


@pytest.mark.skipif(sys.platform == "win32", reason="no fork")
def test_a_forked_child_may_fork_again() -> None:
    wanted = answers()
    child = os.fork()
    if child == 0:
        grandchild = os.fork()
        code = 1
        try:
            check_equal(answers(), wanted)
            code = 0 if grandchild == 0 else os.waitstatus_to_exitcode(os.waitpid(grandchild, 0)[1])
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_twelve_threads_on_one_engine_and_one_rasterizer() -> None:
    wanted = answers()
    engine.cache_clear()
    fresh, made = engine(), OneAtATime.made  # nothing is remembered yet: all threads ask first
    together = threading.Barrier(THREADS)

    def ask(_: int) -> tuple[list[Array], Array, Array]:
        together.wait()
        return answers()

    with ThreadPoolExecutor(THREADS) as pool:
        for found in pool.map(ask, range(THREADS)):
            check_equal(found, wanted)
    assert engine() is fresh
    assert OneAtATime.made == made + 1
