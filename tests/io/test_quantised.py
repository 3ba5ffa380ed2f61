"""Formats that round: .splat, .spz and SOG, each against an encoder of the tests' own; what is
written, and what another program reads."""

import gzip
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import zstandard
from scipy.spatial import cKDTree

from langsplat_core.arrays import rotation_matrices, sigmoid, unit
from langsplat_core.errors import InputError
from langsplat_core.io.quantised import read_splat, write_splat
from langsplat_core.io.scenes import load_gaussians, load_scene
from langsplat_core.io.sog import write_sog
from langsplat_core.io.spz import read_spz_scene, write_spz
from langsplat_core.raster.reference import colours
from langsplat_core.scene import Gaussians
from tests.support.comparing import assert_refused
from tests.support.file_samples import (
    C0,
    sog_files,
    splat_bytes,
    spz_bytes,
    write_folder,
    zipped,
)
from tests.support.scenes import covariances, random_gaussians

# ---- .splat ----


def rotation_error(got: Gaussians, want: Gaussians) -> float:
    matrices = [rotation_matrices(g.quats_wxyz.astype(float)) for g in (got, want)]
    return float(np.abs(matrices[0] - matrices[1]).max())


def check_bytes(got: Gaussians, want: Gaussians) -> None:
    """Colour and opacity in 8 bits; half a step each."""
    colours = np.clip(0.5 + C0 * want.sh[:, 0], 0, 1)
    assert np.abs(0.5 + C0 * got.sh[:, 0] - colours).max() <= 0.5 / 255 + 1e-6
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6


def test_splat_is_written_and_read_back(tmp_path):
    want = random_gaussians(200, sh_degree=2)
    write_splat(tmp_path / "a.splat", want)
    assert (tmp_path / "a.splat").read_bytes() == splat_bytes(want)  # as of another encoder
    got = read_splat(tmp_path / "a.splat")
    assert got.sh_degree == 0
    np.testing.assert_array_equal(got.means, want.means)
    np.testing.assert_allclose(got.log_scales, want.log_scales, atol=1e-6)
    check_bytes(got, want)
    # Half a step of 1/128 a component (a whole one where 128 is cut to 127), at most 3 times in the matrix
    assert rotation_error(got, want) <= 3 / 128
    write_splat(tmp_path / "b.splat", got)
    check_bytes(read_splat(tmp_path / "b.splat"), want)  # a second turn loses nothing more


def test_splat_keeps_rows_that_cannot_be_drawn(tmp_path):
    scene = random_gaussians(8)
    scene.log_scales[0] = -np.inf
    scene.opacity_logits[:2] = np.inf, -np.inf
    scene.sh[2, 0] = 9, -9, 1e4
    scene.means[3] = scene.sh[5, 0] = np.nan
    scene.log_scales[4] = 200  # beyond float32 when it is no logarithm
    write_splat(tmp_path / "a.splat", scene)
    got = read_splat(tmp_path / "a.splat")
    assert np.isneginf(got.log_scales[0]).all()
    assert got.opacity_logits[:2].tolist() == [np.inf, -np.inf]
    np.testing.assert_allclose(0.5 + C0 * got.sh[2, 0], [1, 0, 1], atol=1e-6)
    assert got.valid().all()  # rows that could not be drawn are there, transparent
    assert np.isneginf(got.opacity_logits[3:6]).all()
    np.testing.assert_array_equal(got.means[6:], scene.means[6:])


WANT = random_gaussians(30, sh_degree=1)
SPLAT = splat_bytes(WANT)


def patched(content: bytes, at: int, code: str, value: int) -> bytes:
    """`content` with one number of the type `code` changed."""
    changed = bytearray(content)
    struct.pack_into(code, changed, at, value)
    return bytes(changed)


def test_a_real_splat_is_read(real_data):
    splat = read_splat(real_data / "formats" / "splat" / "minimal.splat")
    assert splat.valid().all()
    np.testing.assert_allclose(splat.means, [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]])


# ---- .spz ----

# Half a step of each code, and the error of a rotation matrix. From version 3 on: half a step of 9 bits over
# [0, 0.71] is 7e-4 a component, amplified up to 5 times in the matrix, whose entries are twice products of
# components, one of them reconstructed. Before: half a step is 1/255, w^2 is off by up to 2 sqrt(3) / 255, so
# that a w near 0 is off by 0.12, and the matrix by 0.24.
POSITION = {1: 2.0**-12, 2: 0.5 / 4096, 3: 0.5 / 4096, 4: 0.5 / 4096}
ROTATION = {1: 0.24, 2: 0.24, 3: 4e-3, 4: 4e-3}


def check_spz(got: Gaussians, want: Gaussians, version: int) -> None:
    assert len(got) == len(want)
    assert got.sh_degree == want.sh_degree
    assert np.abs(got.means - want.means).max() <= POSITION[version] + 1e-7
    assert np.abs(got.log_scales - want.log_scales).max() <= 0.5 / 16 + 1e-6
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    assert np.abs(got.sh[:, 0] - want.sh[:, 0]).max() <= 0.5 / 255 / 0.15 + 1e-5
    # a coefficient of more than 127/128 is cut to that
    higher = np.clip(want.sh[:, 1:], -1, 127 / 128)
    assert np.abs(got.sh[:, 1:] - higher).max(initial=0) <= 0.5 / 128 + 1e-6
    assert rotation_error(got, want) <= ROTATION[version]


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", range(4))
def test_spz_is_exact_to_the_quantisation(put, version, degree):
    want = random_gaussians(150, sh_degree=degree)
    scene = read_spz_scene(put(spz_bytes(want, version)))
    check_spz(scene.gaussians, want, version)
    assert not scene.antialiased
    assert read_spz_scene(put(spz_bytes(want, version, flags=1))).antialiased


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("antialiased", [False, True])
def test_spz_is_written_as_by_another_encoder(tmp_path, degree, antialiased):
    want = random_gaussians(150, sh_degree=degree)
    write_spz(tmp_path / "a.spz", want, antialiased)
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert content == gzip.decompress(spz_bytes(want, 3, flags=int(antialiased)))  # as of another encoder
    once = read_spz_scene(tmp_path / "a.spz").gaussians
    write_spz(tmp_path / "b.spz", once, antialiased)  # a second turn loses nothing more
    again = read_spz_scene(tmp_path / "b.spz").gaussians
    np.testing.assert_array_equal(again.means, once.means)
    np.testing.assert_allclose(again.sh, once.sh, atol=1e-6)


AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("version", [3, 4])
def test_spz_along_other_axes_is_turned(put, axes, version):
    """Other axes, two or none of them mirrored; a record of another kind stands in front."""
    turn = np.diag([1.0 if letter in "RDF" else -1.0 for letter in axes])
    records = struct.pack("<IIxxx", 0x12340001, 3) + struct.pack("<III", 0xADBE0003, 4, AXES.index(axes) + 1)
    want = random_gaussians(60, sh_degree=3)
    got = read_spz_scene(put(spz_bytes(want, version, flags=2, records=records, turn=turn))).gaussians
    np.testing.assert_allclose(got.means, want.means, atol=POSITION[3] + 1e-7)
    for eye in np.random.default_rng(1).normal(size=(3, 3)) * 4:
        seen, truth = (colours(np.clip(g.sh, -1, 127 / 128), want.means, eye) for g in (got, want))
        # Each colour adds 15 coefficients off by at most 1/256, on functions that span less than 1.5
        assert np.abs(seen - truth).max() <= 15 / 256 * 1.5
        assert np.abs(seen - truth).mean() <= 2e-3 * 3
    # scales are off by a factor of at most e^(1/32), their squares by e^(1/16)
    largest = np.exp(2 * want.log_scales.max(axis=1).astype(float))[:, None, None]
    off = np.abs(covariances(got) - covariances(want)) / largest
    assert off.max() <= np.expm1(1 / 16) + 2 * ROTATION[3]


def test_spz_of_degree_four_is_read_to_degree_three(put):
    """In a file that is not zipped, which is read too."""
    want = random_gaussians(20, sh_degree=3)
    content = patched(gzip.decompress(spz_bytes(want, 3)), 12, "B", 4)
    rest = np.frombuffer(content[16 + 20 * 20 :], np.uint8).reshape(20, 45)
    longer = np.concatenate([rest, np.full((20, 27), 200, np.uint8)], axis=1)
    check_spz(read_spz_scene(put(content[: 16 + 20 * 20] + longer.tobytes())).gaussians, want, 3)


def test_spz_keeps_positions_of_small_and_large_scenes(tmp_path):
    """The place of the point follows the scene: steps of a sixteenth of a Gaussian, and no overflow."""
    for radius in (1e-3, 0.1, 30.0, 3000.0, 1e5):
        want = random_gaussians(100, radius=radius, scale_range=(1e-3, 0.02))
        write_spz(tmp_path / "a.spz", want)
        got = read_spz_scene(tmp_path / "a.spz").gaussians
        size = np.exp(np.median(want.log_scales.max(axis=1)))
        step = max(2.0 ** np.ceil(np.log2(radius / (2**23 - 1))), min(1 / 4096, size / 16))
        assert np.abs(got.means - want.means).max() <= 0.5 * step
    far = random_gaussians(100)
    far.means[0, 1] = 1e9
    with pytest.raises(InputError):
        write_spz(tmp_path / "far.spz", far)
    assert not (tmp_path / "far.spz").exists()


def test_spz_writes_undrawable_rows_transparent(tmp_path):
    scene = random_gaussians(10, sh_degree=1)
    scene.means[0] = np.nan
    scene.quats_wxyz[1] = 0
    scene.sh[2, 2] = np.inf
    scene.log_scales[3] = 100
    scene.log_scales[4] = -np.inf  # legal: a point
    scene.opacity_logits[5:7] = np.inf, -np.inf  # legal
    write_spz(tmp_path / "a.spz", scene)
    got = read_spz_scene(tmp_path / "a.spz").gaussians
    assert got.valid().all()
    assert np.isneginf(got.opacity_logits[:4]).all()
    assert got.opacity_logits[5:7].tolist() == [np.inf, -np.inf]
    np.testing.assert_array_equal(got.log_scales[4], -10)
    assert np.abs(got.means[4:] - scene.means[4:]).max() <= POSITION[3] + 1e-7
    write_spz(tmp_path / "b.spz", scene.take(slice(0)))
    (tmp_path / "c.spz").write_bytes(spz_bytes(scene.take(slice(0)), 4))
    assert [len(read_spz_scene(tmp_path / name).gaussians) for name in ("b.spz", "c.spz")] == [0, 0]


@pytest.mark.parametrize("name", ["v3", "v4", "v2", "raw"])
def test_real_spz_agree(real_data, name):
    """3 and 4 were written by Niantic's library, from the Gaussians of the .splat. The others, of version 2,
    were made by hand in a test of another project, of the bytes of the .splat as they are. Axes and colours
    are then not those that .spz means: z is turned round, f_dc stretched by 0.282 / 0.15."""
    folder = real_data / "formats" / "splat"
    want, scene = read_splat(folder / "minimal.splat"), read_spz_scene(folder / f"minimal-{name}.spz")
    got = scene.gaussians
    assert not scene.antialiased
    assert np.abs(got.log_scales - want.log_scales).max() <= 0.5 / 16
    np.testing.assert_array_equal(got.opacity_logits, want.opacity_logits)
    if name in ("v2", "raw"):
        np.testing.assert_array_equal(got.means, want.means * [1, -1, -1])
        assert np.abs(got.sh * 0.15 - want.sh * 0.28209479).max() <= 1 / 255
    else:
        np.testing.assert_array_equal(got.means, want.means)
        assert np.abs(got.sh - want.sh).max() <= 0.5 / 255 / 0.15 + 1e-6
        assert np.abs(covariances(got) - covariances(want)).max() <= 0.01 * np.expm1(1 / 16)


# ---- SOG ----


@pytest.mark.parametrize("degree", range(4))
def test_sog_is_exact_to_the_quantisation(tmp_path, degree):
    want = random_gaussians(150, sh_degree=degree)
    got = load_gaussians(write_folder(tmp_path / "a", sog_files(want)))
    assert len(got) == 150
    assert got.sh_degree == degree
    # 16 bits of sign(x) log(1 + |x|), which stretches by at most 1 + |x| <= 2
    assert np.abs(got.means - want.means).max() <= 2 * np.log(2) * 2 / 65535
    step = np.ptp(want.log_scales) / 255
    assert np.abs(got.log_scales - want.log_scales).max() <= 0.51 * step
    assert np.abs(got.sh[:, 0] - want.sh[:, 0]).max() <= 0.51 * np.ptp(want.sh[:, 0]) / 255
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    # 8 bits over [-0.71, 0.71]: 2.8e-3 a component, amplified as in the compressed PLY
    assert rotation_error(got, want) <= 2.4e-2
    if degree:
        palette = np.clip(want.sh[np.arange(150) % 70, 1:], -1, 1)  # entry i modulo 70
        assert np.abs(got.sh[:, 1:] - palette).max() <= 0.51 * 2 / 255


def test_sog_folder_meta_and_archive_are_equal(tmp_path):
    folder = write_folder(tmp_path / "scene", SOG)
    (tmp_path / "scene.sog").write_bytes(zipped(SOG))
    want = load_gaussians(folder)
    for path in (folder / "meta.json", tmp_path / "scene.sog"):
        np.testing.assert_array_equal(load_gaussians(path).means, want.means)
        np.testing.assert_array_equal(load_scene(path).gaussians.sh, want.sh)


SOG = sog_files(random_gaussians(40, sh_degree=1))


def meta_with(**entries: object) -> dict[str, bytes]:
    """The files of `SOG` with other entries in the JSON, part__entry for one in a part; None: without it."""
    meta = json.loads(SOG["meta.json"])
    for name, value in entries.items():
        *part, key = name.split("__")
        within = meta[part[0]] if part else meta
        within[key] = value
        if value is None:
            del within[key]
    return SOG | {"meta.json": json.dumps(meta).encode()}


def with_positions_of(size: int) -> bytes:
    """`SPZ_4` with a first stream of `size` bytes, of which the table says 270."""
    frame = zstandard.ZstdCompressor().compress(bytes(size))
    old, start = struct.unpack_from("<Q", SPZ_4, 32)[0], 32 + 6 * 16
    return patched(SPZ_4[:start], 32, "<Q", len(frame)) + frame + SPZ_4[start + old :]


SPZ, SPZ_4 = gzip.decompress(spz_bytes(WANT, 3)), spz_bytes(WANT, 4)
AXES_9 = spz_bytes(WANT, 4, flags=2, records=struct.pack("<III", 0xADBE0003, 4, 9))
MOST = 2**32 - 1
MALFORMED = {  # what a file with this ending holds
    "a.splat": (b"", SPLAT[:-1], SPLAT + b"\0", np.random.default_rng(0).bytes(3200)),
    "a.spz": (
        *(b"words of no meaning, none", gzip.compress(b"words of no meaning")),
        *(patched(SPZ, *change) for change in ((4, "<I", 0), (4, "<I", 5), (12, "B", 5))),
        *(gzip.compress(patched(SPZ, 8, "<I", count)) for count in (31, MOST)),
        *(spz_bytes(WANT, 3)[:300], spz_bytes(WANT, 3)[:-8] + bytes(8), gzip.compress(SPZ + bytes(2**21))),
        *(SPZ_4[:30], SPZ_4[:60], patched(SPZ_4, 8, "<I", MOST), AXES_9),
        *(patched(SPZ_4, 16, "<I", table) for table in (10**9, 8)),
        *(patched(SPZ_4, *change) for change in ((15, "B", 5), (32, "<Q", 2**63), (40, "<Q", 271))),
        *(patched(SPZ_4, 32 + 6 * 16, "<I", 0), with_positions_of(269), with_positions_of(271)),
    ),
    "a.sog": tuple(
        zipped(files)
        for files in (
            *(meta_with(version=None), meta_with(version=3)),
            *(meta_with(count=count) for count in (None, "9", -1, 70, 10**9)),
            *(meta_with(means__mins=bounds) for bounds in ([0, 0], ["0"] * 3, [10**400] * 3)),
            *(meta_with(sh0__codebook=[0.0] * 255), meta_with(scales=None), meta_with(scales="x")),
            *(meta_with(quats__files=[]), meta_with(quats__files=["../a/quats.webp"])),
            *(meta_with(shN__bands=5), meta_with(shN__count=20), meta_with(shN__bands=2)),
            *(SOG | {"quats.webp": SOG["sh0.webp"]}, SOG | {"sh0.webp": b"RIFF words"}),
            *(SOG | {"meta.json": text} for text in (b"{", b"[" * 100_000, b"[]")),
        )
    ),
}


@pytest.mark.parametrize(
    ("name", "number"), [(name, number) for name in MALFORMED for number in range(len(MALFORMED[name]))]
)
def test_malformed_files_are_refused_in_a_line(put, bounded, name, number):
    assert_refused(load_gaussians, put(MALFORMED[name][number], name))


def test_missing_files_of_a_sog_are_named(tmp_path):
    files = {name: content for name, content in SOG.items() if name != "quats.webp"}
    write_folder(tmp_path / "a", files)
    (tmp_path / "b.sog").write_bytes(zipped(files))
    (tmp_path / "c.sog").write_bytes(b"PK words")
    for name, message in (
        ("a", r"quats\.webp: no such file"),
        ("b.sog", r"b\.sog: has no 'quats.webp' inside"),
        ("c.sog", r"c\.sog: not a readable SOG archive"),
        ("d.sog", "no such file"),
    ):
        with pytest.raises(InputError, match=message):
            load_gaussians(tmp_path / name)


@pytest.mark.parametrize(("name", "count"), [("playbot_8k_sog", 8406), ("playbot_31k_sog", 31000)])
def test_real_sogs_are_read(real_data, name, count):
    got = load_gaussians(real_data / "gaussians" / name)
    assert len(got) == count
    assert got.sh_degree == 2
    assert got.valid().all()
    # On flat ground the shortest axis is the ground's normal: true of w x y z (0.98), not of other orders.
    near = got.means[cKDTree(got.means).query(got.means[::10], k=12)[1]].astype(np.float64)
    _, spread, axes = np.linalg.svd(near - near.mean(1, keepdims=True), full_matrices=False)
    flat = spread[:, 2] < 0.15 * spread[:, 1]
    shortest = got.log_scales[::10].argmin(1)[:, None, None]
    normals = np.take_along_axis(rotation_matrices(got.quats_wxyz[::10].astype(float)), shortest, 2)[..., 0]
    assert np.median(np.abs((normals * axes[:, 2]).sum(1))[flat]) > 0.95


# ---- SOG, written ----


def written(tmp_path, gaussians: Gaussians) -> Gaussians:
    write_sog(tmp_path / "a.sog", gaussians)
    return load_gaussians(tmp_path / "a.sog")


def angles(one: Gaussians, other: Gaussians) -> np.ndarray:
    """Degrees between the rotations of two scenes."""
    cosines = np.abs((unit(one.quats_wxyz.astype(float)) * unit(other.quats_wxyz.astype(float))).sum(1))
    return 2 * np.degrees(np.arccos(np.clip(cosines, 0, 1)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sog_is_written_and_read_back(tmp_path, degree):
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


@pytest.mark.long
def test_sog_shares_palette_entries_of_large_scenes(tmp_path):
    rng = np.random.default_rng(0)
    scene = random_gaussians(70_000, sh_degree=1)
    kinds = rng.normal(size=(40, 3, 3)).astype(np.float32)
    rest = kinds[rng.integers(0, 40, 70_000)] + 0.01 * rng.normal(size=(70_000, 3, 3)).astype(np.float32)
    scene = replace(scene, sh=np.concatenate([scene.sh[:, :1], rest], axis=1))
    got = written(tmp_path, scene)
    assert np.sqrt(((got.sh[:, 1:] - rest) ** 2).mean()) < 0.1 * rest.std()


def test_sog_writes_rows_that_cannot_be_drawn(tmp_path):
    hard = random_gaussians(8, sh_degree=1)
    hard.means[:2] = [[np.nan], [1e8]]
    hard.log_scales[2] = [-np.inf, 0, 1]
    hard.quats_wxyz[3:5] *= [[0], [-1]]
    hard.opacity_logits[5:7] = np.inf, -np.inf
    got = written(tmp_path, hard)
    assert got.opacity_logits[[0, 3, 5, 6]].tolist() == [-np.inf, -np.inf, np.inf, -np.inf]
    assert got.means[1] == pytest.approx(hard.means[1], rel=1e-2)
    assert np.isfinite(got.log_scales).all()
    assert angles(hard.take([4]), got.take([4])).max() < 1
    for count in (0, 1):
        assert len(written(tmp_path, random_gaussians(count, sh_degree=2))) == count


def test_sog_is_deterministic(tmp_path):
    scene = random_gaussians(500, sh_degree=1)
    write_sog(tmp_path / "a.sog", scene)
    write_sog(tmp_path / "b.sog", scene)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
