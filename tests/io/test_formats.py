"""Formats other than PLY: .splat, .spz and SOG against the tests' own encoders, glTF, points and meshes."""

import gzip
import json
import struct
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load, save

from langsplat_core.arrays import rotation_matrices, sigmoid, unit
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.io.gltf import EXTENSION, PACKED, write_gltf
from langsplat_core.io.quantised import mirrored, read_splat_scene, write_splat
from langsplat_core.io.scenes import CORE_FORMATS, load_scene, save_scene, write_origin
from langsplat_core.io.sidecar import read_language, write_language
from langsplat_core.io.sog import write_sog
from langsplat_core.io.spz import read_spz_scene, write_spz
from langsplat_core.raster.reference import colours
from langsplat_core.scene import Camera, Gaussians, Scene, look_at
from langsplat_core.scene.transform import AXES as UP
from langsplat_core.scene.transform import moving, rotating, scaling, similarity, transform_gaussians, turning
from tests.support.file_samples import (
    C0,
    assert_refused,
    assert_same,
    assert_same_field,
    bytes_of,
    compressed_ply,
    glb,
    glb_column,
    load_gaussians,
    parts,
    plain_ply,
    random_field,
    same_or_a_line,
    sog_files,
    splat_bytes,
    spz_bytes,
    write_folder,
    zipped,
)
from tests.support.file_samples import HALF_TURN as RUB
from tests.support.scenes import covariances, random_camera, random_gaussians

# ---- .splat ----


def rotation_error(got: Gaussians, want: Gaussians) -> float:
    matrices = [rotation_matrices(g.quats_wxyz.astype(float)) for g in (got, want)]
    return float(np.abs(matrices[0] - matrices[1]).max())


def check_bytes(got: Gaussians, want: Gaussians) -> None:
    """Colour and opacity in 8 bits; half a step each."""
    colours = np.clip(0.5 + C0 * want.sh[:, 0], 0, 1)
    assert np.abs(0.5 + C0 * got.sh[:, 0] - colours).max() <= 0.5 / 255 + 1e-6
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6


def test_splat_is_written_and_read_back(tmp_path, caplog):
    want = random_gaussians(200, sh_degree=2)
    want.sh[:3, 0] = 2.5  # a little brighter than white
    write_splat(tmp_path / "a.splat", Scene(want))
    assert caplog.messages == [".splat: the colours of 3 of 200 Gaussians are beyond it and are cut"]
    assert (tmp_path / "a.splat").read_bytes() == splat_bytes(want)  # as of another encoder
    got = read_splat_scene(tmp_path / "a.splat").gaussians
    assert got.sh_degree == 0
    np.testing.assert_array_equal(got.means, want.means)
    np.testing.assert_allclose(got.log_scales, want.log_scales, atol=1e-6)
    check_bytes(got, want)
    # Half a step of 1/128 a component (a whole one where 128 is cut to 127), at most 3 times in the matrix
    assert rotation_error(got, want) <= 3 / 128
    write_splat(tmp_path / "b.splat", Scene(got))
    with pytest.raises(InputError, match="would be an empty file"):
        write_splat(tmp_path / "c.splat", Scene(want.take([])))
    want.means[0, 1] = 1e9
    with pytest.raises(InputError, match="spz"):
        write_spz(tmp_path / "far.spz", Scene(want))
    assert not (tmp_path / "far.spz").exists()
    check_bytes(read_splat_scene(tmp_path / "b.splat").gaussians, want)  # a second turn loses nothing more


WANT = random_gaussians(30, sh_degree=1)
SPLAT = splat_bytes(WANT)


def patched(content: bytes, at: int, code: str, value: int) -> bytes:
    changed = bytearray(content)
    struct.pack_into(code, changed, at, value)
    return bytes(changed)


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


AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")


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
@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("axes", "turn"), [("rub", RUB), ("rdf", np.eye(3))])
def test_spz_is_written_as_by_another_encoder(tmp_path, caplog, degree, antialiased, version, axes, turn):
    want = random_gaussians(150, sh_degree=degree)
    want.sh[:7, -1, 1] = -1.5
    write_spz(tmp_path / "a.spz", Scene(want, antialiased=antialiased), version, axes)
    record = struct.pack("<III", 0xADBE0003, 4, AXES.index(axes.upper()) + 1)
    theirs = spz_bytes(want, version, flags=antialiased + 2, records=record, turn=turn)
    unzipped = gzip.decompress if version == 3 else bytes
    assert unzipped((tmp_path / "a.spz").read_bytes()) == unzipped(theirs)
    assert (".spz: the coefficients of 7 of 150 Gaussians" in caplog.text) == (degree > 0)
    once = read_spz_scene(tmp_path / "a.spz").gaussians
    write_spz(tmp_path / "b.spz", Scene(once, antialiased=antialiased))  # a second turn loses nothing more
    again = read_spz_scene(tmp_path / "b.spz").gaussians
    np.testing.assert_array_equal(again.means, once.means)
    np.testing.assert_allclose(again.sh, once.sh, atol=1e-6)


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


@pytest.mark.parametrize("up", ["-y", "z"])
def test_spz_that_looks_upside_down_is_told(tmp_path, caplog, up):
    """A floor with a little above it, without a record, as Niantic's library has it and splat-transform."""
    means = np.random.default_rng(0).uniform(-2, 2, (1500, 3))
    means[:1000, 1] = 2.0  # y down
    shape = np.tile(np.log([0.1, 0.002, 0.1]), (1500, 1))
    gaussians = Gaussians(means, shape, np.tile([1.0, 0, 0, 0], (1500, 1)), np.zeros(1500), means[:, None])
    want = transform_gaussians(gaussians, turning(UP["-y"], UP[up]))
    if up == "z":
        eyes = [np.array([x, y, 1.0]) for x in (-3, 3) for y in (-3, 3)]
        cameras = [look_at(eye, np.zeros(3), UP["z"], (9, 9)) for eye in eyes]
        write_cameras(tmp_path / "a.cameras.json", cameras)
    path = tmp_path / "a.spz"
    path.write_bytes(spz_bytes(want, 3))
    np.testing.assert_allclose(read_spz_scene(path).gaussians.means, want.means, atol=2e-4)
    assert not caplog.messages
    path.write_bytes(spz_bytes(want, 3, turn=np.eye(3)))
    read_spz_scene(path)
    assert ["--axes rdf" in message for message in caplog.messages] == [True]
    np.testing.assert_allclose(read_spz_scene(path, "rdf").gaussians.means, want.means, atol=2e-4)
    assert len(caplog.messages) == 1
    write_spz(path, Scene(mirrored(want, np.array([1, -1, -1]))))
    read_spz_scene(path)  # says what it is
    assert len(caplog.messages) == 1


def test_spz_of_degree_four_is_read_to_degree_three(put):
    """In a file that is not zipped, which is read too."""
    want = random_gaussians(20, sh_degree=3)
    content = patched(gzip.decompress(spz_bytes(want, 3)), 12, "B", 4)
    rest = np.frombuffer(content[16 + 20 * 20 :], np.uint8).reshape(20, 45)
    longer = np.concatenate([rest, np.full((20, 27), 200, np.uint8)], axis=1)
    check_spz(read_spz_scene(put(content[: 16 + 20 * 20] + longer.tobytes())).gaussians, want, 3)


@pytest.mark.parametrize("suffix", [row.suffix for row in CORE_FORMATS])
@pytest.mark.parametrize("decade", range(-6, 7))
@pytest.mark.parametrize("sizes", [(0.01, 0.1), (1e-5, 1e-4), (1.0, 2.0)])
def test_numbers_of_twelve_decades_are_kept_or_refused(tmp_path, suffix, decade, sizes):
    """A size is the last that matters of a place: what is written is as exact as Gaussians are large."""
    want = random_gaussians(60, radius=10.0**decade, scale_range=sizes)
    path = tmp_path / f"a{suffix}"
    rounds = suffix in (".spz", ".sog")
    with suppress(*[InputError] * rounds):
        save_scene(path, Scene(want))
    if not path.exists():
        return
    got = load_gaussians(path)
    longest = want.log_scales.max(axis=1)
    apart = np.linalg.norm(got.means - want.means, axis=1)
    assert np.median(apart / np.exp(longest)) < 1
    if suffix == ".spz":  # the place of the point follows the scene
        step = 2.0 ** np.ceil(np.log2(10.0**decade / (2**23 - 1)))
        step = max(step, min(1 / 4096, np.exp(np.median(longest)) / 16))
        assert np.abs(got.means - want.means).max() <= 0.5 * step
    assert np.median(np.abs(got.log_scales.max(axis=1) - longest)) < 0.1
    if not rounds:
        np.testing.assert_array_equal(got.means, want.means)


@pytest.mark.parametrize("name", ["v3", "v4"])
def test_real_spz_agree(real_data, name):
    """Written by Niantic's library, from the Gaussians of the .splat."""
    folder = real_data / "formats" / "splat"
    want, got = (load_gaussians(folder / f"minimal{end}") for end in (".splat", f"-{name}.spz"))
    assert np.abs(got.log_scales - want.log_scales).max() <= 0.5 / 16
    np.testing.assert_array_equal(got.opacity_logits, want.opacity_logits)
    np.testing.assert_array_equal(got.means, want.means)
    assert np.abs(got.sh - want.sh).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert np.abs(covariances(got) - covariances(want)).max() <= 0.01 * np.expm1(1 / 16)


# ---- SOG ----


@pytest.mark.parametrize("degree", range(4))
def test_sog_is_exact_to_the_quantisation(tmp_path, degree):
    want = random_gaussians(150, sh_degree=degree)
    folder = write_folder(tmp_path / "a", sog_files(want))
    (tmp_path / "a.sog").write_bytes(zipped(sog_files(want)))
    got, *others = (load_gaussians(path) for path in (folder, folder / "meta.json", tmp_path / "a.sog"))
    for other in others:
        assert_same(got, other)
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


def test_a_sog_says_antialiased(tmp_path):
    plain = [{}, {"model": "2dgs"}, {"model": ["antialiased"]}, {"antialias": False}, {"antialias": "no"}]
    for entry in (*plain, {"model": "antialiased"}, {"antialias": True}):
        scene = load_scene(write_folder(tmp_path / "a", meta_with(**entry)))
        assert scene.antialiased is (entry not in plain)


def test_a_far_sog_is_exact_to_its_quantisation(tmp_path):
    low, high = np.log1p([5e6, 5e6 + 16])  # float32 has steps of half a unit there
    far = write_folder(tmp_path / "far", meta_with(means__mins=[low] * 3, means__maxs=[high] * 3))
    near, scene = load_gaussians(write_folder(tmp_path / "near", SOG)).means, load_scene(far)
    least, most = (np.array(json.loads(SOG["meta.json"])["means"][name]) for name in ("mins", "maxs"))
    shares = (np.sign(near) * np.log1p(np.abs(near)) - least) / (most - least)
    want = np.expm1(low + (high - low) * shares)
    np.testing.assert_allclose(scene.in_world(scene.gaussians.means), want, rtol=0, atol=1e-4)
    write_origin(tmp_path / "far.origin.json", np.array([0, 100, 0]))
    np.testing.assert_array_equal(load_scene(far).origin, scene.origin + (0, 100, 0))


def written(tmp_path, gaussians: Gaussians) -> Gaussians:
    write_sog(tmp_path / "a.sog", Scene(gaussians))
    return load_gaussians(tmp_path / "a.sog")


@pytest.mark.parametrize("degree", range(4))
def test_sog_is_written_and_read_back(tmp_path, degree):
    scene = random_gaussians(3000, sh_degree=degree)
    got = written(tmp_path, scene)
    assert got.sh.shape == scene.sh.shape
    logs = np.log1p(np.abs(scene.means.astype(np.float64)))
    step = (logs.max() * 2) / 65535 * np.exp(logs)
    assert (np.abs(got.means - scene.means) <= step).all()
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(scene.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    assert rotation_error(got, scene) <= 2.4e-2
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


# ---- all that are written ----


@pytest.mark.parametrize("suffix", [".splat", ".spz", ".sog", ".glb", ".gltf"])
def test_rows_that_cannot_be_drawn_are_transparent(tmp_path, suffix):
    path, scene = tmp_path / f"a{suffix}", random_gaussians(10, sh_degree=1)
    scene.means[0], scene.quats_wxyz[1], scene.sh[2, 0], scene.log_scales[3] = np.nan, 0, np.nan, 200
    scene.opacity_logits[4:6] = np.inf, -np.inf  # legal, as is a flat axis
    scene.log_scales[6, 0] = -np.inf
    scene.quats_wxyz[7] *= -7
    scene.opacity_logits[3] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_scene(path, Scene(scene))
    got = load_gaussians(path)
    assert got.valid().all()
    assert got.opacity_logits[:6].tolist() == [*[-np.inf] * 4, np.inf, -np.inf]
    assert got.log_scales[6, 0] < -9.9
    assert np.abs(got.means[4:] - scene.means[4:]).max() < 1e-3
    assert rotation_error(got.take([7]), scene.take([7])) < 3 / 128
    for count in (0, 1)[suffix == ".splat" :]:
        save_scene(path, Scene(scene.take(np.arange(count))))
        assert len(load_gaussians(path)) == count


# ---- glTF ----

HALF_TURN = rotating(np.array([0, 0, 1]), 180)  # between the axes of glTF and those of the PLY


def changed(path: Path, scene: Gaussians, change: Callable[[dict], object] = lambda content: None) -> Path:
    """`scene` as a .glb whose JSON is changed in place."""
    write_gltf(path, Scene(scene))
    content, binary = parts(path.read_bytes())
    change(content)
    path.write_bytes(glb(content, binary))
    return path


def assert_alike(got: Gaussians, want: Gaussians, places: float = 1e-5) -> None:
    np.testing.assert_allclose(got.means, want.means, atol=places)
    np.testing.assert_allclose(got.log_scales, want.log_scales, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(got.sh, want.sh, atol=1e-5)
    np.testing.assert_allclose(sigmoid(got.opacity_logits), sigmoid(want.opacity_logits), atol=1e-6)
    one, other = (unit(rows.quats_wxyz.astype(np.float64)) for rows in (got, want))
    assert (np.abs((one * other).sum(1)) > 1 - 1e-9).all()


def test_written_axes_are_those_of_the_standard(tmp_path):
    """The file itself, read by its own words, is the scene half a turn about z further."""
    scene = random_gaussians(50, sh_degree=3)
    write_gltf(tmp_path / "a.glb", Scene(scene))
    content, binary = parts((tmp_path / "a.glb").read_bytes())

    column = partial(glb_column, content, binary)
    want = transform_gaussians(scene, HALF_TURN)
    np.testing.assert_allclose(column("POSITION"), want.means, atol=1e-6)
    np.testing.assert_allclose(column(f"{EXTENSION}:SCALE"), np.exp(want.log_scales), rtol=1e-5)
    for number, degree, coefficient in ((0, 0, 0), (1, 1, 0), (8, 2, 4), (9, 3, 0), (15, 3, 6)):
        found = column(f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{coefficient}")
        np.testing.assert_allclose(found, want.sh[:, number], atol=1e-5)
    # the shapes, of which quaternions are one way to say them
    made = replace(want, quats_wxyz=column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]])
    np.testing.assert_allclose(covariances(made), covariances(want), atol=1e-5 * covariances(want).max())


def test_nodes_place_their_primitives(tmp_path):
    scene = random_gaussians(40, sh_degree=3)
    turn = rotating(np.array([1.0, 2, 3]), 70)

    def place(content: dict) -> None:
        half = np.radians(35)
        x, y, z = np.sin(half) * np.array([1, 2, 3]) / np.sqrt(14)
        content["nodes"] = [
            {"mesh": 0, "rotation": [x, y, z, np.cos(half)], "scale": [2, 2, 2]},
            {"children": [0], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        ]
        content["scenes"] = [{"nodes": [1]}]

    there = scaling(2).then(turn).then(moving(np.array([5.0, 6, 7])))
    want = transform_gaussians(scene, HALF_TURN.then(there).then(HALF_TURN))
    assert_alike(load_gaussians(changed(tmp_path / "a.glb", scene, place)), want, 1e-4)


def test_a_scene_comes_back_about_its_own_axes_unless_moved(tmp_path):
    scene = replace(
        Scene(random_gaussians(40, sh_degree=3), cameras=(random_camera(1),)),
        metres_per_unit=0.25,
        antialiased=True,
    )
    write_gltf(tmp_path / "a.glb", scene)
    got = load_scene(tmp_path / "a.glb")
    np.testing.assert_array_equal(got.gaussians.means, scene.gaussians.means)
    assert (got.metres_per_unit, got.antialiased) == (0.25, True)
    content, binary = parts((tmp_path / "a.glb").read_bytes())
    node = np.array(content["nodes"][0]["matrix"]).reshape(4, 4).T
    up = [*np.diag(HALF_TURN.rotation) * scene.up(), 1]
    np.testing.assert_allclose(node @ up, [0, 0.25, 0, 1], atol=1e-9)
    content["nodes"][0]["matrix"][12] += 3.0
    (tmp_path / "b.glb").write_bytes(glb(content, binary))
    moved = HALF_TURN.then(similarity(node)).then(moving(np.array([3.0, 0, 0]))).then(HALF_TURN)
    assert_alike(load_gaussians(tmp_path / "b.glb"), transform_gaussians(scene.gaussians, moved), 1e-4)


def one_mesh(attributes: dict[str, int], extension: dict, size: int, **buffer: str) -> dict:
    """The JSON of a file of one primitive, its numbers in a buffer of `size` bytes; without its columns."""
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: extension}}
    return {
        "asset": {"version": "2.0"},
        "bufferViews": [{"buffer": 0, "byteLength": size}],
        "buffers": [{"byteLength": size, **buffer}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
    }


@pytest.mark.parametrize("name", PACKED)
def test_an_spz_inside_is_read(tmp_path, name):
    write_spz(tmp_path / "a.spz", Scene(random_gaussians(60, sh_degree=2)))
    data = (tmp_path / "a.spz").read_bytes()
    inside = {"extensions": {name: {"bufferView": 0}}}
    content = one_mesh({"POSITION": 0}, inside, len(data)) | {
        "extensionsRequired": [EXTENSION, name],
        "accessors": [{"count": 60, "type": "VEC3", "componentType": 5126}],
    }
    (tmp_path / "a.glb").write_bytes(glb(content, data))
    assert_alike(load_gaussians(tmp_path / "a.glb"), load_gaussians(tmp_path / "a.spz"))


def test_quantised_and_interleaved_columns_are_read(tmp_path):
    rows = np.zeros(3, [("p", "<f4", 3), ("q", "i1", 4), ("s", "i1", 4), ("o", "u1", 4)])
    rows["p"], rows["q"], rows["s"][:, :3], rows["o"][:, 0] = 1, [0, 0, 0, -127], [0, 1, 2], [0, 51, 255]
    offsets = {"POSITION": (0, 5126, "VEC3"), "ROTATION": (12, 5120, "VEC4"), "SCALE": (16, 5120, "VEC3")}
    offsets |= {"OPACITY": (20, 5121, "SCALAR"), "SH_DEGREE_0_COEF_0": (0, 5126, "VEC3")}
    names = [name if name == "POSITION" else f"{EXTENSION}:{name}" for name in offsets]
    content = one_mesh({name: i for i, name in enumerate(names)}, {}, 72, uri="b%20c.bin")
    content["bufferViews"][0]["byteStride"] = 24
    content["accessors"] = [
        {"bufferView": 0, "byteOffset": at, "componentType": kind, "type": shape, "count": 3}
        | {"normalized": name in ("ROTATION", "OPACITY")}
        for name, (at, kind, shape) in offsets.items()
    ]
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    (tmp_path / "b c.bin").write_bytes(rows.tobytes())
    got = load_gaussians(tmp_path / "a.gltf")
    np.testing.assert_allclose(np.exp(got.log_scales), [[0, 1, 2]] * 3)
    np.testing.assert_allclose(sigmoid(got.opacity_logits), [0, 0.2, 1], atol=1e-6)
    np.testing.assert_array_equal(np.abs(got.quats_wxyz), [[1, 0, 0, 0]] * 3)
    rows["s"][1] = -3  # of a draft of the extension: logarithms
    (tmp_path / "b c.bin").write_bytes(rows.tobytes())
    np.testing.assert_array_equal(load_gaussians(tmp_path / "a.gltf").log_scales[1], [-3, -3, -3])


def splats(content: dict) -> dict:
    return content["meshes"][0]["primitives"][0]


MALFORMED_GLTF = {
    "a path": lambda c: c["buffers"][0].update(uri="../../etc/passwd"),
    "many rows": lambda c: [one.update(count=2**31) for one in c["accessors"]],
    "a sparse column": lambda c: c["accessors"][0].update(sparse={"count": 1}),
    "a circle": lambda c: c["nodes"][0].update(children=[0]),
    "many instances": lambda c: c.update(nodes=[{"mesh": 0}] * 9999, scenes=[{"nodes": list(range(9999))}]),
    "a mirror": lambda c: c["nodes"][0].update(scale=[-1, 1, 1]),
    "an axis of its own": lambda c: c["nodes"][0].update(scale=[1, 2, 1]),
    "meshopt": lambda c: c.update(extensionsRequired=["EXT_meshopt_compression"]),
    "triangles": lambda c: splats(c).update(mode=4),
    "linear colours": lambda c: splats(c)["extensions"][EXTENSION].update(colorSpace="lin_rec709_display"),
    "no Gaussians": lambda c: c.update(nodes=[], scenes=[], extensionsUsed=[]),
}


@pytest.mark.parametrize("name", MALFORMED_GLTF)
def test_malformed_gltf_is_refused_in_a_line(tmp_path, name):
    path = changed(tmp_path / "a.glb", random_gaussians(20, sh_degree=1), MALFORMED_GLTF[name])
    assert_refused(load_gaussians, path)


def test_written_files_keep_the_rules(tmp_path):
    """Of glTF: aligned views in one buffer, bounds of positions; of the extension: all that it requires."""
    write_gltf(tmp_path / "a.glb", Scene(random_gaussians(7, sh_degree=1)))
    data = (tmp_path / "a.glb").read_bytes()
    content, binary = parts(data)
    assert struct.unpack_from("<I", data, 8)[0] == len(data)
    assert content["buffers"][0]["byteLength"] == len(binary)
    assert all(view["byteOffset"] % 4 == 0 for view in content["bufferViews"])
    says, attributes = splats(content)["extensions"][EXTENSION], splats(content)["attributes"]
    assert says["kernel"] == "ellipse"
    assert says["colorSpace"] == "srgb_rec709_display"
    coefficients = ("0_COEF_0", *(f"1_COEF_{n}" for n in range(3)))
    names = {"ROTATION", "SCALE", "OPACITY", *(f"SH_DEGREE_{name}" for name in coefficients)}
    assert set(attributes) == {"POSITION", "COLOR_0", *(f"{EXTENSION}:{name}" for name in names)}
    positions = content["accessors"][attributes["POSITION"]]
    assert np.less(positions["min"], positions["max"]).all()


# ---- changes that leave a file well-formed: the same comes out, or a line, or an error ----


def changed_ply(data: bytes, rng: np.random.Generator) -> bytes:
    """A table with columns in another order, or of another number; with more around it, or less."""
    header, body = data.split(b"end_header\n", 1)
    lines = header.decode().splitlines()
    at = rng.choice([row for row, line in enumerate(lines) if line.startswith("property")])
    match rng.integers(8):
        case 0:
            lines[at : at + 1] = [lines[at]] * int(2 * rng.integers(2))
        case 1:
            rows = [row for row, line in enumerate(lines) if line.startswith("element")]
            name, count = lines[rng.choice(rows)].rsplit(" ", 1)
            less = str(int(count) + int(rng.choice([-1, 1, 300])))
            lines = [f"{name} {less}" if line.startswith(name) else line for line in lines]
        case 2:
            body += bytes(rng.integers(256, size=rng.integers(1, 400), dtype=np.uint8))
        case 3:
            lines, body = [*lines, "element intrinsic 2", "property float fx"], body + bytes(8)
        case 4:
            said = ["antialiased 0", "antialiased yes", "SplatRenderMode: 3d", "metres_per_unit none"]
            lines[2:2] = [f"comment {text}" for text in rng.choice(said, 2)]
        case _ if b"nx" in header:
            names = [line.split()[-1] for line in lines if line.startswith("property")]
            table = np.frombuffer(body, [(name, "<f4") for name in names])
            names = [name for name in rng.permutation(names) if name[0] != "n" or rng.integers(2)]
            columns = [table[name] + np.float32(name == "nz" and rng.integers(2)) for name in names]
            lines = [line for line in lines if not line.startswith("property")]
            lines += [f"property float {name}" for name in names]
            body = np.column_stack(columns).astype("<f4").tobytes()
    return "\n".join([*lines, "end_header\n"]).encode() + body


def changed_spz(data: bytes, rng: np.random.Generator) -> bytes:
    """With records, flags, bytes and a number of Gaussians that are not those of its maker."""
    zipped = data[:2] == b"\x1f\x8b"
    data = gzip.decompress(data) if zipped else data
    other = struct.pack("<II", int(rng.integers(1, 9)), 4) + bytes(int(rng.integers(7)))
    match rng.integers(4):
        case 0:
            data = patched(data, 14, "B", int(rng.choice([0, 4, 128])))
        case 1:
            data += other
        case 2 if zipped:
            data = patched(data, 14, "B", 2) + other
        case _:
            data = patched(data, 8, "<I", int(rng.integers(28, 33)))
    return gzip.compress(data) if zipped else data


def without(content: dict, rng: np.random.Generator) -> None:
    """Drop an entry of an object or of one within it."""
    parts = [content, *(part for part in content.values() if isinstance(part, dict))]
    part = parts[rng.integers(len(parts))]
    del part[str(rng.choice(sorted(part)))]


def changed_sog(files: dict[str, bytes], rng: np.random.Generator) -> bytes:
    meta, files = json.loads(files["meta.json"]), dict(files)
    match rng.integers(5):
        case 0:
            without(meta, rng)
        case 1:
            meta["count"] += int(rng.integers(-30, 3))
        case 2:
            meta |= {str(rng.choice(["model", "antialias", "lod"])): str(rng.choice(["2dgs", "no"]))}
        case 3:
            del files[str(rng.choice(sorted(files)))]
        case _:
            files["more.webp"] = files["sh0.webp"]
    return zipped(files | ({"meta.json": json.dumps(meta).encode()} if "meta.json" in files else {}))


def changed_glb(data: bytes, rng: np.random.Generator) -> bytes:
    content, binary = parts(data)
    says, attributes = splats(content)["extensions"][EXTENSION], splats(content)["attributes"]
    match rng.integers(8):
        case 0:
            del attributes[str(rng.choice(sorted(attributes)))]
        case 1:
            attributes["_MORE"] = 0
        case 2:
            content["meshes"].append({"primitives": [splats(content)]})
            content["nodes"] += [{"mesh": 1}] * int(rng.integers(2))
        case 3:
            content["meshes"][0]["primitives"].append({"attributes": {}})
        case 4:
            content["scenes"].append({"nodes": [0]})
            del content["scene"]
        case 5:
            says |= {str(rng.choice(["kernel", "projection", "sortingMethod"])): "another"}
        case 6:
            content["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {}}
        case _:
            content[str(rng.choice(["cameras", "animations", "extras"]))] = [{}]
    return glb(content, binary) + bytes(4 * int(rng.integers(2)))


def changed_sidecar(data: bytes, rng: np.random.Generator) -> bytes:
    size = struct.unpack_from("<Q", data)[0]
    about = json.loads(data[8 : 8 + size])["__metadata__"]
    tensors = load(data)
    match rng.integers(4):
        case 0:
            del tensors[str(rng.choice(sorted(tensors.keys() - {"everyday"})))]  # which may be absent
        case 1:
            del about[str(rng.choice(sorted(about.keys() - {"odds"})))]  # likewise
        case 2:
            tensors[str(rng.choice(["codec.more", "taught", "more"]))] = np.zeros(3, np.float32)
        case _:
            about["more"] = "1"
    return save(tensors, about)


def changed_cameras(data: bytes, rng: np.random.Generator) -> bytes:
    cameras = json.loads(data)
    at = int(rng.integers(len(cameras)))
    match rng.integers(3):
        case 0:
            del cameras[at][str(rng.choice(sorted(cameras[at].keys() - {"img_name"})))]
        case 1:
            cameras[at]["k1"] = 0.1
        case _:
            cameras = [dict(sorted(camera.items())) for camera in cameras]
    return json.dumps(cameras).encode()


def assert_same_scene(got: Scene, want: Scene) -> None:
    assert (got.antialiased, got.metres_per_unit) == (want.antialiased, want.metres_per_unit)
    assert_same(got.gaussians, want.gaussians)


def assert_same_cameras(got: Sequence[Camera], want: Sequence[Camera]) -> None:
    views = [[(c.name, c.intrinsics, c.world_to_camera.tolist()) for c in cameras] for cameras in (got, want)]
    assert views[0] == views[1]


NAMED = tuple(replace(random_camera(seed), name=f"view {seed}") for seed in range(2))
GLTF = parts(bytes_of(write_gltf, Scene(WANT)))
CHANGED: dict[str, tuple[str, Any, Callable[..., bytes]]] = {  # the name of a file, a good one, its changes
    "PLY": ("a.ply", plain_ply(WANT), changed_ply),
    "compressed PLY": ("a.ply", compressed_ply(random_gaussians(300, sh_degree=1)), changed_ply),
    **{f"SPZ {v}": ("a.spz", spz_bytes(WANT, v), changed_spz) for v in (2, 3, 4)},
    "SOG": ("a.sog", sog_files(random_gaussians(40, sh_degree=1), 40), changed_sog),
    "glTF": ("a.glb", glb(GLTF[0] | {"materials": [{}]}, GLTF[1]), changed_glb),
    "sidecar": ("a.safetensors", bytes_of(write_language, random_field(30), WANT.means), changed_sidecar),
    "cameras": ("a.json", bytes_of(write_cameras, NAMED), changed_cameras),
}


@pytest.mark.parametrize("kind", CHANGED)
def test_a_changed_file_gives_the_same_or_a_line(put, kind, caplog):
    name, good, change = CHANGED[kind]
    readers: dict[str, tuple[Any, Any]] = {
        ".json": (read_cameras, assert_same_cameras),
        ".safetensors": (lambda path: read_language(path, WANT.means), assert_same_field),
    }
    read, check = readers.get(Path(name).suffix, (load_scene, assert_same_scene))
    want = read(put(zipped(good) if isinstance(good, dict) else good, name))
    assert not caplog.messages
    said = 0
    for seed in range(120):
        caplog.clear()
        path = put(change(good, np.random.default_rng(seed)), name)
        said += same_or_a_line(partial(read, path), partial(check, want=want), caplog)
    assert said > 5
