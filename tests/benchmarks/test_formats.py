"""The errors of the report `formats`, where they are known."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.scene import Scene
from tests.benchmarks.formats import errors, rows
from tests.support.scenes import random_gaussians


def test_errors_are_those_that_were_made():
    want = random_gaussians(20, sh_degree=2)
    assert errors(want, want) == [0] * 6
    half = np.radians(10) / 2
    w, x, y, z = want.quats_wxyz[3].astype(float)
    turned = want.quats_wxyz.astype(float).copy()
    # followed by 10 degrees about z, and with the other sign, which says the same
    turned[3] = -np.array([w, x, y, z]) * np.cos(half) - np.array([-z, -y, x, w]) * np.sin(half)
    means, scales, sh = want.means.copy(), want.log_scales.copy(), want.sh.copy()
    means[1, 2] += 0.5
    scales[2, scales[2].argmax()] += np.log(1.25)
    sh[4, 5, 1] -= 0.25
    got = replace(want, means=means, log_scales=scales, quats_wxyz=turned, sh=sh)
    assert errors(want, got) == pytest.approx([0.5, 25, 10, 0, 0, 0.25], rel=1e-4)
    bare = replace(want, sh=want.sh[:, :1])  # what is lost is an error too
    assert errors(want, bare)[5] == np.abs(want.sh[:, 1:]).max()


def test_every_writable_format_has_its_row():
    table = {row[0]: row[1:] for row in rows(Scene(random_gaussians(300, sh_degree=1)))}
    assert set(table) == {".ply", ".spz", ".splat", ".sog", ".glb", ".gltf"}
    assert table[".ply"][1:] == ["0"] * 6 + ["100.0"]
