"""Photographs beyond the limit lie in files, and are the same pictures."""

import numpy as np

from langsplat_core.datasets.album import Album


def test_what_memory_does_not_hold_is_filed_unchanged(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    pictures = np.random.default_rng(0).integers(256, size=(5, 6, 8, 3)).astype(np.uint8)
    album = Album(in_memory=2 * pictures[0].nbytes + 1)
    kept = [album.keep(picture) for picture in pictures]
    assert [isinstance(picture, np.memmap) for picture in kept] == [False, False, True, True, True]
    np.testing.assert_array_equal(np.stack(kept), pictures)
    assert list(tmp_path.iterdir()) == []  # the files have no name: nothing is left behind
