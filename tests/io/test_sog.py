"""Reading SOG version 2: a folder, its meta.json, or one .sog file."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from langsplat_core.arrays import rotation_matrices, sigmoid
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.io.sog import read_sog
from tests.support.file_samples import SHARED_DATA, sog_files, write_folder, zipped
from tests.support.scenes import random_gaussians

PLAYBOT = SHARED_DATA / "gaussians"


@pytest.mark.parametrize("degree", range(4))
def test_decoding_is_exact_up_to_the_quantisation(tmp_path, degree):
    want = random_gaussians(150, sh_degree=degree)
    got = read_sog(write_folder(tmp_path / "a", sog_files(want)))
    assert len(got) == 150
    assert got.sh_degree == degree
    # 16 bits of sign(x) log(1 + |x|), which stretches by at most 1 + |x| <= 2
    assert np.abs(got.means - want.means).max() <= 2 * np.log(2) * 2 / 65535
    step = np.ptp(want.log_scales) / 255
    assert np.abs(got.log_scales - want.log_scales).max() <= 0.51 * step
    assert np.abs(got.sh[:, 0] - want.sh[:, 0]).max() <= 0.51 * np.ptp(want.sh[:, 0]) / 255
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    # 8 bits over [-0.71, 0.71]: 2.8e-3 a component, amplified as in the compressed PLY
    turned = rotation_matrices(got.quats_wxyz.astype(float)) - rotation_matrices(
        want.quats_wxyz.astype(float)
    )
    assert np.abs(turned).max() <= 2.4e-2
    if degree:
        palette = np.clip(want.sh[np.arange(150) % 70, 1:], -1, 1)  # entry i modulo 70
        assert np.abs(got.sh[:, 1:] - palette).max() <= 0.51 * 2 / 255


def test_folder_meta_and_archive_say_the_same(tmp_path):
    files = sog_files(random_gaussians(40, sh_degree=1))
    folder = write_folder(tmp_path / "scene", files)
    (tmp_path / "scene.sog").write_bytes(zipped(files))
    want = read_sog(folder)
    for path in (folder / "meta.json", tmp_path / "scene.sog"):
        np.testing.assert_array_equal(read_sog(path).means, want.means)
        np.testing.assert_array_equal(load_scene(path).gaussians.sh, want.sh)


def test_opacities_of_nought_and_one_are_infinite_logits(tmp_path):
    scene = random_gaussians(30)
    scene.opacity_logits[:2] = np.inf, -np.inf
    got = read_sog(write_folder(tmp_path / "a", sog_files(scene)))
    assert got.opacity_logits[0] == np.inf
    assert got.opacity_logits[1] == -np.inf


def broken_meta(change):
    files = sog_files(random_gaussians(40, sh_degree=1))
    meta = json.loads(files["meta.json"])
    change(meta)
    files["meta.json"] = json.dumps(meta).encode()
    return files


def swapped(name, other):
    files = sog_files(random_gaussians(40, sh_degree=1))
    files[name] = files.get(other, other)
    return files


BROKEN = {
    "version 1": (lambda: broken_meta(lambda m: m.pop("version")), "SOG version 1; only 2 is read"),
    "version 3": (lambda: broken_meta(lambda m: m.update(version=3)), "SOG version 3"),
    "no count": (lambda: broken_meta(lambda m: m.pop("count")), "count is missing"),
    "a count of text": (lambda: broken_meta(lambda m: m.update(count="9")), "count is not a whole number"),
    "a negative count": (lambda: broken_meta(lambda m: m.update(count=-1)), "count is not a whole number"),
    "more than the images hold": (lambda: broken_meta(lambda m: m.update(count=70)), "does not suit 70"),
    "a billion": (lambda: broken_meta(lambda m: m.update(count=10**9)), "too few for 1000000000 Gaussians"),
    "three bounds": (
        lambda: broken_meta(lambda m: m["means"].update(mins=[0, 0])),
        "means.mins is not a list",
    ),
    "bounds of text": (lambda: broken_meta(lambda m: m["means"].update(mins=["0"] * 3)), "means.mins is not"),
    "bounds beyond float": (
        lambda: broken_meta(lambda m: m["means"].update(mins=[10**400] * 3)),
        "means.mins is not",
    ),
    "a short codebook": (
        lambda: broken_meta(lambda m: m["sh0"]["codebook"].pop()),
        "sh0.codebook is not a list",
    ),
    "no scales": (lambda: broken_meta(lambda m: m.pop("scales")), "scales.codebook is missing"),
    "scales of text": (lambda: broken_meta(lambda m: m.update(scales="x")), "scales.codebook is missing"),
    "no file name": (lambda: broken_meta(lambda m: m["quats"].update(files=[])), "quats.files has no plain"),
    "a path for a name": (
        lambda: broken_meta(lambda m: m["quats"].update(files=["../a/quats.webp"])),
        "quats.files has no plain file name",
    ),
    "five bands": (
        lambda: broken_meta(lambda m: m["shN"].update(bands=5)),
        "shN.bands is not a whole number",
    ),
    "too few entries": (lambda: broken_meta(lambda m: m["shN"].update(count=20)), "a label of 'shN' is 39"),
    "a narrow palette": (lambda: broken_meta(lambda m: m["shN"].update(bands=2)), "does not suit"),
    "quaternions without a tag": (lambda: swapped("quats.webp", "sh0.webp"), "alpha below 252"),
    "an image of words": (
        lambda: swapped("sh0.webp", b"RIFF words"),
        "'sh0.webp' of 'sh0': not a readable picture",
    ),
    "not JSON": (lambda: swapped("meta.json", b"{"), "not readable as JSON"),
    "nested JSON": (lambda: swapped("meta.json", b"[" * 100_000), "not readable as JSON"),
    "a list": (lambda: swapped("meta.json", b"[]"), "expected a JSON object"),
}


@pytest.mark.parametrize("case", BROKEN)
@pytest.mark.parametrize("archive", [False, True])
def test_every_broken_rule_has_its_message(tmp_path, case, archive):
    make, message = BROKEN[case]
    path = tmp_path / "a.sog"
    if archive:
        path.write_bytes(zipped(make()))
    else:
        write_folder(path, make())
    with pytest.raises(FormatError, match=message) as caught:
        read_sog(path)
    assert str(path) in str(caught.value)


def test_missing_files(tmp_path):
    files = sog_files(random_gaussians(40))
    del files["quats.webp"]
    with pytest.raises(InputError, match=r"quats\.webp: no such file"):
        read_sog(write_folder(tmp_path / "a", files))
    (tmp_path / "b.sog").write_bytes(zipped(files))
    with pytest.raises(FormatError, match=r"b\.sog: has no 'quats.webp' inside"):
        read_sog(tmp_path / "b.sog")
    (tmp_path / "c.sog").write_bytes(b"PK words")
    with pytest.raises(FormatError, match=r"c\.sog: not a readable SOG archive"):
        read_sog(tmp_path / "c.sog")
    with pytest.raises(InputError, match="no such file"):
        read_sog(tmp_path / "d.sog")


@pytest.mark.parametrize(("name", "count"), [("playbot_8k_sog", 8406), ("playbot_31k_sog", 31000)])
def test_real_scenes(name, count):
    if not (PLAYBOT / name).exists():
        pytest.skip("the shared data are not here")
    got = read_sog(PLAYBOT / name)
    assert len(got) == count
    assert got.sh_degree == 2
    assert got.valid().all()
    # On flat ground the shortest axis is the ground's normal: true of w x y z (0.98), not of other orders.
    _, near = cKDTree(got.means).query(got.means[::10], k=12)
    offsets = got.means[near].astype(np.float64)
    offsets -= offsets.mean(1, keepdims=True)
    _, spread, axes = np.linalg.svd(offsets, full_matrices=False)
    flat = spread[:, 2] < 0.15 * spread[:, 1]
    shortest = got.log_scales[::10].argmin(1)[:, None, None]
    normals = np.take_along_axis(rotation_matrices(got.quats_wxyz[::10].astype(float)), shortest, 2)[..., 0]
    assert np.median(np.abs((normals * axes[:, 2]).sum(1))[flat]) > 0.95
