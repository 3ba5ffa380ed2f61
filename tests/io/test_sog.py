"""Writing SOG: errors within those of the format, rows in order, hard cases, what another program reads."""

import json
import shutil
import subprocess
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import sigmoid, unit
from langsplat_core.io import sog
from langsplat_core.io.scenes import load_gaussians
from langsplat_core.io.sog import write_sog
from langsplat_core.scene import Gaussians
from tests.support.scenes import random_gaussians


def written(tmp_path, gaussians: Gaussians) -> Gaussians:
    write_sog(tmp_path / "a.sog", gaussians)
    return load_gaussians(tmp_path / "a.sog")


def angles(one: Gaussians, other: Gaussians) -> np.ndarray:
    """Degrees between the rotations of two scenes."""
    cosines = np.abs((unit(one.quats_wxyz.astype(float)) * unit(other.quats_wxyz.astype(float))).sum(1))
    return 2 * np.degrees(np.arccos(np.clip(cosines, 0, 1)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rows_come_back_in_their_order_within_the_format_s_rounding(tmp_path, degree):
    scene = random_gaussians(3000, sh_degree=degree)
    got = written(tmp_path, scene)
    assert got.sh.shape == scene.sh.shape
    logs = np.log1p(np.abs(scene.means.astype(np.float64)))
    step = (logs.max() * 2) / 65535 * np.exp(logs)
    assert (np.abs(got.means - scene.means) <= step).all()
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(scene.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    assert angles(scene, got).max() < 1.0
    for name in ("log_scales", "sh"):
        have, want = getattr(got, name), getattr(scene, name)
        assert np.abs(have - want).mean() < 0.01 * want.std()
        assert np.abs(have - want).max() < 0.05 * np.ptp(want)


def test_a_palette_shares_entries_where_there_are_too_many(tmp_path, monkeypatch):
    monkeypatch.setattr(sog, "MOST_ENTRIES", 256)
    rng = np.random.default_rng(0)
    scene = random_gaussians(5000, sh_degree=1)
    kinds = rng.normal(size=(40, 3, 3)).astype(np.float32)
    rest = kinds[rng.integers(0, 40, 5000)] + 0.01 * rng.normal(size=(5000, 3, 3)).astype(np.float32)
    scene = replace(scene, sh=np.concatenate([scene.sh[:, :1], rest], axis=1))
    got = written(tmp_path, scene)
    assert np.sqrt(((got.sh[:, 1:] - rest) ** 2).mean()) < 0.1 * rest.std()
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert json.loads(archive.read("meta.json"))["shN"]["count"] <= 256


def test_hard_rows_are_written(tmp_path):
    scene = random_gaussians(8, sh_degree=1)
    means, scales, quats = scene.means.copy(), scene.log_scales.copy(), scene.quats_wxyz.copy()
    means[0] = np.nan
    means[1] = 1e8
    scales[2] = [-np.inf, 0, 1]
    quats[3] = 0
    quats[4] *= -1
    logits = scene.opacity_logits.copy()
    logits[5], logits[6] = np.inf, -np.inf
    hard = replace(scene, means=means, log_scales=scales, quats_wxyz=quats, opacity_logits=logits)
    got = written(tmp_path, hard)
    opacities = sigmoid(got.opacity_logits.astype(np.float64))
    assert opacities[0] == opacities[3] == opacities[6] == 0
    assert opacities[5] == 1
    assert got.means[1] == pytest.approx(means[1], rel=1e-2)
    assert np.isfinite(got.log_scales).all()
    assert angles(hard.take(np.array([4])), got.take(np.array([4]))).max() < 1
    for count in (0, 1):
        assert len(written(tmp_path, random_gaussians(8, sh_degree=2).take(np.arange(count)))) == count


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    scene = random_gaussians(500, sh_degree=1)
    write_sog(tmp_path / "a.sog", scene)
    write_sog(tmp_path / "b.sog", scene)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_splat_transform_reads_it_alike(tmp_path):
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("splat-transform of @playcanvas is not installed")
    mine = written(tmp_path, random_gaussians(2000, sh_degree=2))
    subprocess.run([program, "-w", "-q", tmp_path / "a.sog", tmp_path / "b.ply"], check=True, timeout=120)
    theirs = load_gaussians(tmp_path / "b.ply")
    for name in ("means", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(mine, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sigmoid(theirs.opacity_logits), sigmoid(mine.opacity_logits), atol=1e-6)
    assert angles(mine, theirs).max() < 0.05
