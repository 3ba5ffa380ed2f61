"""Photographs beyond the limit lie in files, and are the same pictures."""

import errno

import numpy as np
import pytest

from langsplat_core.datasets.capture import Album
from tests.support.full_disk import files_of_at_most


def test_what_memory_does_not_hold_is_filed_unchanged(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    pictures = np.random.default_rng(0).integers(256, size=(5, 6, 8, 3)).astype(np.uint8)
    album = Album(in_memory=2 * pictures[0].nbytes + 1)
    kept = [album.keep(picture) for picture in pictures]
    assert [isinstance(picture, np.memmap) for picture in kept] == [False, False, True, True, True]
    np.testing.assert_array_equal(np.stack(kept), pictures)
    assert list(tmp_path.iterdir()) == []  # the files have no name: nothing is left behind


def test_a_full_disk_is_said_and_not_a_dead_process(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    picture = np.zeros((60, 80, 3), np.uint8)
    for size in (0, picture.nbytes - 1):
        with files_of_at_most(size), pytest.raises(OSError, match="large") as caught:
            Album(in_memory=0).keep(picture)
        assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(tmp_path))
