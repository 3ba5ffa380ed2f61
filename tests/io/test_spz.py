"""Reading and writing .spz."""

import gzip
import struct

import numpy as np
import pytest
import zstandard

from langsplat_core.arrays import rotation_matrices, sigmoid
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.splat import read_splat
from langsplat_core.io.spz import read_spz_scene, write_spz
from langsplat_core.raster.reference import colours
from langsplat_core.scene import Gaussians
from tests.support.file_samples import spz_bytes
from tests.support.scenes import covariances, random_gaussians

# Half a step of each code, and the error of a rotation matrix. From version 3 on: half a step of 9 bits over
# [0, 0.71] is 7e-4 a component, amplified up to 5 times in the matrix, whose entries are twice products of
# components, one of them reconstructed. Before: half a step is 1/255, w^2 is off by up to 2 sqrt(3) / 255, so
# that a w near 0 is off by 0.12, and the matrix by 0.24.
POSITION = {1: 2.0**-12, 2: 0.5 / 4096, 3: 0.5 / 4096, 4: 0.5 / 4096}
ROTATION = {1: 0.24, 2: 0.24, 3: 4e-3, 4: 4e-3}


@pytest.fixture
def put(tmp_path):
    def write(content: bytes):
        path = tmp_path / "a.spz"
        path.write_bytes(content)
        return path

    return write


def check(got: Gaussians, want: Gaussians, version: int) -> None:
    assert len(got) == len(want)
    assert got.sh_degree == want.sh_degree
    assert np.abs(got.means - want.means).max() <= POSITION[version] + 1e-7
    assert np.abs(got.log_scales - want.log_scales).max() <= 0.5 / 16 + 1e-6
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    assert np.abs(got.sh[:, 0] - want.sh[:, 0]).max() <= 0.5 / 255 / 0.15 + 1e-5
    # a coefficient of more than 127/128 is cut to that
    higher = np.clip(want.sh[:, 1:], -1, 127 / 128)
    assert np.abs(got.sh[:, 1:] - higher).max(initial=0) <= 0.5 / 128 + 1e-6
    turned = rotation_matrices(got.quats_wxyz.astype(float)) - rotation_matrices(
        want.quats_wxyz.astype(float)
    )
    assert np.abs(turned).max() <= ROTATION[version]


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", range(4))
def test_decoding_is_exact_up_to_the_quantisation(put, version, degree):
    want = random_gaussians(150, sh_degree=degree)
    scene = read_spz_scene(put(spz_bytes(want, version)))
    check(scene.gaussians, want, version)
    assert not scene.antialiased
    assert read_spz_scene(put(spz_bytes(want, version, flags=1))).antialiased


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("antialiased", [False, True])
def test_what_is_written_is_read(tmp_path, degree, antialiased):
    want = random_gaussians(150, sh_degree=degree)
    write_spz(tmp_path / "a.spz", want, antialiased)
    scene = read_spz_scene(tmp_path / "a.spz")
    check(scene.gaussians, want, 3)
    assert scene.antialiased == antialiased
    content = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert content == gzip.decompress(spz_bytes(want, 3, flags=int(antialiased)))
    write_spz(tmp_path / "b.spz", scene.gaussians, antialiased)  # a second turn loses nothing more
    again = read_spz_scene(tmp_path / "b.spz").gaussians
    np.testing.assert_array_equal(again.means, scene.gaussians.means)
    np.testing.assert_allclose(again.sh, scene.gaussians.sh, atol=1e-6)


AXES = ("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF")


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("version", [3, 4])
def test_files_with_other_axes_say_so(put, axes, version):
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
    assert (np.abs(covariances(got) - covariances(want)) / largest).max() <= np.expm1(1 / 16) + 2 * ROTATION[
        3
    ]


def test_degree_four_is_left_out(put):
    want = random_gaussians(20, sh_degree=3)
    content = bytearray(gzip.decompress(spz_bytes(want, 3)))
    content[12] = 4
    rest = np.frombuffer(content[16 + 20 * 20 :], np.uint8).reshape(20, 45)
    longer = np.concatenate([rest, np.full((20, 27), 200, np.uint8)], axis=1)
    got = read_spz_scene(put(bytes(content[: 16 + 20 * 20]) + longer.tobytes())).gaussians
    check(got, want, 3)


def test_unzipped_files_are_read(put):
    want = random_gaussians(20)
    check(read_spz_scene(put(gzip.decompress(spz_bytes(want, 2)))).gaussians, want, 2)


def test_small_and_large_scenes_keep_their_positions(tmp_path):
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
    with pytest.raises(InputError, match=r"beyond the 24 bits of \.spz; write \.ply"):
        write_spz(tmp_path / "far.spz", far)
    assert not (tmp_path / "far.spz").exists()


def test_rows_that_cannot_be_drawn_stay_but_are_not_seen(tmp_path):
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
    assert got.opacity_logits[5] == np.inf
    assert got.opacity_logits[6] == -np.inf
    np.testing.assert_array_equal(got.log_scales[4], -10)
    assert np.abs(got.means[4:] - scene.means[4:]).max() <= POSITION[3] + 1e-7
    empty = scene.take(np.zeros(0, int))
    (tmp_path / "c.spz").write_bytes(spz_bytes(empty, 4))
    assert len(read_spz_scene(tmp_path / "c.spz").gaussians) == 0
    write_spz(tmp_path / "b.spz", empty)
    assert len(read_spz_scene(tmp_path / "b.spz").gaussians) == 0


# ---- broken files ----

WANT = random_gaussians(30, sh_degree=1)


def zipped(at: int, code: str, value: int) -> bytes:
    content = bytearray(gzip.decompress(spz_bytes(WANT, 3)))
    struct.pack_into(code, content, at, value)
    return gzip.compress(bytes(content))


def version4(at: int, code: str, value: int) -> bytes:
    content = bytearray(spz_bytes(WANT, 4))
    struct.pack_into(code, content, at, value)
    return bytes(content)


def axes_record(value: int) -> bytes:
    return spz_bytes(WANT, 4, flags=2, records=struct.pack("<III", 0xADBE0003, 4, value))


BROKEN = {
    "words": (lambda: b"words of no meaning, none", "not an .spz file"),
    "zipped words": (lambda: gzip.compress(b"words of no meaning"), "not an .spz file"),
    "version 0": (lambda: zipped(4, "<I", 0), "version 0"),
    "version 5": (lambda: zipped(4, "<I", 5), "version 5"),
    "degree 5": (lambda: zipped(12, "B", 5), "SH degree 5"),
    "one more": (lambda: zipped(8, "<I", 31), "truncated: 31 Gaussians"),
    "2^32 of them": (lambda: zipped(8, "<I", 2**32 - 1), "truncated: 4294967295 Gaussians"),
    "half a file": (lambda: spz_bytes(WANT, 3)[:300], "not a whole gzip stream"),
    "a wrong checksum": (lambda: spz_bytes(WANT, 3)[:-8] + bytes(8), "not a whole gzip stream"),
    "much behind": (
        lambda: gzip.compress(gzip.decompress(spz_bytes(WANT, 3)) + bytes(2**21)),
        "too many bytes behind",
    ),
    "4: 2^32 of them": (lambda: version4(8, "<I", 2**32 - 1), "not those of 4294967295 Gaussians"),
    "4: the header alone": (lambda: version4(8, "<I", 30)[:30], "truncated: an .spz of version 4"),
    "4: no table": (lambda: version4(8, "<I", 30)[:60], "truncated: .* bytes are missing"),
    "4: a table far off": (lambda: version4(16, "<I", 10**9), "its table at byte 1000000000"),
    "4: a table in the header": (lambda: version4(16, "<I", 8), "its table at byte 8"),
    "4: a stream fewer": (lambda: version4(15, "B", 5), "not those of 30 Gaussians"),
    "4: a long stream": (lambda: version4(32, "<Q", 2**63), "truncated: its streams do not fit"),
    "4: a stream of others": (lambda: version4(40, "<Q", 271), "not those of 30 Gaussians"),
    "4: no Zstandard": (lambda: version4(32 + 6 * 16, "<I", 0), "a stream cannot be unpacked"),
    "4: axes of a kind": (lambda: axes_record(9), "its axes are of kind 9"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(put, case):
    make, message = BROKEN[case]
    with pytest.raises(FormatError, match=message) as caught:
        read_spz_scene(put(make()))
    assert "\n" not in str(caught.value)


def test_a_frame_of_another_size_than_its_table_says(put):
    content = spz_bytes(WANT, 4)
    old = struct.unpack_from("<Q", content, 32)[0]
    start = 32 + 6 * 16
    for size in (269, 271):
        frame = zstandard.ZstdCompressor().compress(bytes(size))
        new = (
            content[:32] + struct.pack("<Q", len(frame)) + content[40:start] + frame + content[start + old :]
        )
        with pytest.raises(FormatError, match="fewer or more than the 270 bytes"):
            read_spz_scene(put(new))


# ---- real files ----


def test_real_files_agree(real_data):
    """3 and 4 were written by Niantic's library, from the Gaussians of the .splat."""
    folder = real_data / "formats" / "splat"
    want = read_splat(folder / "minimal.splat")
    for version in (3, 4):
        scene = read_spz_scene(folder / f"minimal-v{version}.spz")
        got = scene.gaussians
        assert not scene.antialiased
        np.testing.assert_array_equal(got.means, want.means)
        assert np.abs(got.log_scales - want.log_scales).max() <= 0.5 / 16
        assert np.abs(got.sh - want.sh).max() <= 0.5 / 255 / 0.15 + 1e-6
        np.testing.assert_array_equal(got.opacity_logits, want.opacity_logits)
        assert np.abs(covariances(got) - covariances(want)).max() <= 0.01 * np.expm1(1 / 16)


def test_real_files_of_version_2(real_data):
    """Made by hand in a test of another project: the bytes of the .splat as they are. Axes and colours are
    therefore not those that .spz means: z is turned round, f_dc stretched by 0.282 / 0.15."""
    folder = real_data / "formats" / "splat"
    want = read_splat(folder / "minimal.splat")
    for name in ("minimal-v2.spz", "minimal-raw.spz"):
        got = read_spz_scene(folder / name).gaussians
        np.testing.assert_array_equal(got.means, want.means * [1, -1, -1])
        assert np.abs(got.sh * 0.15 - want.sh * 0.28209479).max() <= 1 / 255
        assert np.abs(got.log_scales - want.log_scales).max() <= 0.5 / 16
        np.testing.assert_array_equal(got.opacity_logits, want.opacity_logits)
