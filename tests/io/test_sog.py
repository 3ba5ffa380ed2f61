"""Writing SOG: errors within those of the format, rows in order, hard cases, what another program reads."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from langsplat_core.arrays import sigmoid, unit
from langsplat_core.errors import InputError
from langsplat_core.io import sog
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import load_gaussians, scene_files
from langsplat_core.io.sog import write_sog
from langsplat_core.scene import Gaussians
from langsplat_core.scene.gaussians import join_gaussians
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
    hard = random_gaussians(8, sh_degree=1)
    hard.means[:2] = [[np.nan], [1e8]]
    hard.log_scales[2] = [-np.inf, 0, 1]
    hard.quats_wxyz[3:5] *= [[0], [-1]]
    hard.opacity_logits[5:7] = np.inf, -np.inf
    got = written(tmp_path, hard)
    opacities = sigmoid(got.opacity_logits.astype(np.float64))
    assert opacities[[0, 3, 5, 6]].tolist() == [0, 0, 1, 0]
    assert got.means[1] == pytest.approx(hard.means[1], rel=1e-2)
    assert np.isfinite(got.log_scales).all()
    assert angles(hard.take([4]), got.take([4])).max() < 1
    for count in (0, 1):
        assert len(written(tmp_path, random_gaussians(count, sh_degree=2))) == count


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    scene = random_gaussians(500, sh_degree=1)
    write_sog(tmp_path / "a.sog", scene)
    write_sog(tmp_path / "b.sog", scene)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_splat_transform_reads_it_alike(tmp_path, splat_transform):
    mine = written(tmp_path, random_gaussians(2000, sh_degree=2))
    splat_transform(tmp_path / "a.sog", tmp_path / "b.ply")
    theirs = load_gaussians(tmp_path / "b.ply")
    for name in ("means", "log_scales", "sh"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(mine, name), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sigmoid(theirs.opacity_logits), sigmoid(mine.opacity_logits), atol=1e-6)
    assert angles(mine, theirs).max() < 0.05


def streamed(folder, parts: list[Gaussians], change=lambda content: None):
    """A streamed scene: each of `parts` a leaf of the finest level, in two files; a coarse row."""
    for name, some in {"0_0": parts[:-1], "0_1": parts[-1:], "1_0": [parts[0].take(np.arange(1))]}.items():
        write_sog(folder / "packed.sog", join_gaussians(some))
        with zipfile.ZipFile(folder / "packed.sog") as archive:
            archive.extractall(folder / name)
    (folder / "packed.sog").unlink()
    places = ((0, 0), (0, len(parts[0])), (2, 0))
    leaves = [
        {"lods": {"0": {"file": file, "offset": offset, "count": len(part)}}}
        for (file, offset), part in zip(places, parts, strict=True)
    ]
    leaves[0]["lods"]["1"] = {"file": 1, "offset": 0, "count": 1}
    tree = {"children": [leaves[0], {"children": leaves[1:]}]}
    names = ["0_0/meta.json", "1_0/meta.json", "0_1/meta.json"]
    content = {"version": 1, "lodLevels": 2, "filenames": names, "tree": tree}
    change(content)
    (folder / "lod-meta.json").write_text(json.dumps(content))
    return folder


def three_parts() -> list[Gaussians]:
    return [random_gaussians(count, seed=count, sh_degree=1) for count in (30, 40, 50)]


def test_a_streamed_scene_is_read_at_its_finest_level(tmp_path):
    parts = three_parts()
    folder = streamed(tmp_path, parts)
    for path in (folder, folder / "lod-meta.json"):
        got = load_gaussians(path)
        assert len(got) == 120
        assert np.abs(got.means - join_gaussians(parts).means).max() < 1e-3  # in the order of the tree
    files = scene_files(folder)
    assert files[0] == folder / "lod-meta.json"
    assert {path.parent.name for path in files if path.suffix == ".webp"} == {"0_0", "0_1", "1_0"}

    def surroundings(content: dict) -> None:
        content["filenames"].pop(1)  # of the coarse level, which is not asked for
        content["filenames"].insert(1, "none/meta.json")
        content["environment"] = "1_0/meta.json"

    assert len(load_gaussians(streamed(tmp_path, parts, surroundings))) == 121


LIES = {
    "a path": lambda c: c["filenames"].__setitem__(0, "../x/meta.json"),
    "a missing file": lambda c: c["filenames"].__setitem__(0, "3_0/meta.json"),
    "itself": lambda c: c["filenames"].__setitem__(0, "lod-meta.json"),
    "a file twice": lambda c: c["filenames"].__setitem__(2, "0_0/meta.json"),
    "rows beyond the end": lambda c: c["tree"]["children"][0]["lods"]["0"].update(count=71),
    "rows again and again": lambda c: c["tree"]["children"].extend([c["tree"]["children"][0]] * 99),
    "negative rows": lambda c: c["tree"]["children"][0]["lods"]["0"].update(offset=-1),
    "no tree": lambda c: c.pop("tree"),
    "a tree of numbers": lambda c: c["tree"].update(children=[1]),
}


@pytest.mark.parametrize("name", LIES)
def test_a_streamed_scene_that_lies_is_refused(tmp_path, name):
    with pytest.raises(InputError):
        load_gaussians(streamed(tmp_path, three_parts(), LIES[name]))


@pytest.mark.slow
def test_what_splat_transform_streams_is_read(tmp_path, splat_transform):
    scene, path = random_gaussians(30_000, sh_degree=1), tmp_path / "a.ply"
    write_ply(path, scene)
    lod = tmp_path / "lod" / "lod-meta.json"
    splat_transform("-g", "cpu", "-C", "8", path, "-l", "0", path, "-F", "20%", "-l", "1", lod)
    got = load_gaussians(tmp_path / "lod")
    assert len(got) == len(scene)
    near, _ = cKDTree(got.means).query(scene.means)
    assert near.max() < 1e-3
