"""Reading and writing .splat, reading .ksplat."""

import struct

import numpy as np
import pytest

from langsplat_core.arrays import rotation_matrices, sigmoid
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.splat import read_ksplat, read_splat, write_splat
from langsplat_core.scene import Gaussians
from tests.support.file_samples import C0, ksplat_bytes, splat_bytes
from tests.support.scenes import covariances, random_gaussians


@pytest.fixture
def put(tmp_path):
    def write(content: bytes, name: str):
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


def rotation_error(got: Gaussians, want: Gaussians) -> float:
    matrices = [rotation_matrices(g.quats_wxyz.astype(float)) for g in (got, want)]
    return float(np.abs(matrices[0] - matrices[1]).max())


def check_bytes(got: Gaussians, want: Gaussians) -> None:
    """Colour and opacity in 8 bits; half a step each."""
    colours = np.clip(0.5 + C0 * want.sh[:, 0], 0, 1)
    assert np.abs(0.5 + C0 * got.sh[:, 0] - colours).max() <= 0.5 / 255 + 1e-6
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6


def test_a_splat_of_another_encoder(put):
    want = random_gaussians(200)
    got = read_splat(put(splat_bytes(want), "a.splat"))
    assert got.sh_degree == 0
    np.testing.assert_array_equal(got.means, want.means)
    np.testing.assert_allclose(got.log_scales, want.log_scales, atol=1e-6)
    check_bytes(got, want)
    # Half a step of 1/128 a component (a whole one where 128 is cut to 127), at most 3 times in the matrix
    assert rotation_error(got, want) <= 3 / 128


def test_what_is_written_is_read(put, tmp_path):
    want = random_gaussians(200, sh_degree=2)
    write_splat(tmp_path / "a.splat", want)
    assert (tmp_path / "a.splat").read_bytes() == splat_bytes(want)
    got = read_splat(tmp_path / "a.splat")
    write_splat(tmp_path / "b.splat", got)
    assert len(got) == 200
    check_bytes(read_splat(tmp_path / "b.splat"), want)  # a second turn loses nothing more


def test_splat_extremes(tmp_path):
    scene = random_gaussians(8)
    scene.log_scales[0] = -np.inf
    scene.opacity_logits[:2] = np.inf, -np.inf
    scene.sh[2, 0] = 9, -9, 1e4
    scene.means[3] = np.nan
    scene.sh[5, 0] = np.nan
    scene.log_scales[4] = 200  # beyond float32 when it is no logarithm
    write_splat(tmp_path / "a.splat", scene)
    got = read_splat(tmp_path / "a.splat")
    assert np.isneginf(got.log_scales[0]).all()
    assert got.opacity_logits[0] == np.inf
    assert got.opacity_logits[1] == -np.inf
    np.testing.assert_allclose(0.5 + C0 * got.sh[2, 0], [1, 0, 1], atol=1e-6)
    assert got.valid().all()  # rows that could not be drawn are there, transparent
    assert np.isneginf(got.opacity_logits[3:6]).all()
    np.testing.assert_array_equal(got.means[6:], scene.means[6:])


def test_what_is_no_splat(put):
    content = splat_bytes(random_gaussians(20))
    for broken in (b"", content[:-1], content + b"\0"):
        with pytest.raises(FormatError, match="not a whole number of Gaussians of 32"):
            read_splat(put(broken, "a.splat"))
    with pytest.raises(FormatError, match=r"\d+ of 100 rows are no Gaussians"):
        read_splat(put(np.random.default_rng(0).bytes(3200), "a.splat"))
    with pytest.raises(InputError, match="no such file"):
        read_splat("nowhere.splat")


@pytest.mark.parametrize("level", range(3))
@pytest.mark.parametrize("degree", range(4))
def test_ksplat(put, level, degree):
    want = random_gaussians(61, sh_degree=degree)
    got = read_ksplat(put(ksplat_bytes([want], level), "a.ksplat"))
    assert len(got) == 61
    assert got.sh_degree == degree
    # Half a code of 2.5 / 32767; float16 has 11 bits
    assert np.abs(got.means - want.means).max() <= (0.51 * 2.5 / 32767 if level else 0)
    assert np.abs(got.log_scales - want.log_scales).max() <= (2**-11 if level else 1e-6)
    assert rotation_error(got, want) <= (4 * 2**-12 * 2 if level else 1e-5)
    check_bytes(got, want)
    rest = np.abs(
        got.sh[:, 1:] - np.clip(want.sh[:, 1:], -1.5, 1.5) if level == 2 else got.sh[:, 1:] - want.sh[:, 1:]
    )
    assert rest.max(initial=0) <= (0, 2**-11, 0.51 * 3 / 255)[level]


def test_ksplat_of_sections_of_different_degrees(put):
    parts = [random_gaussians(30, sh_degree=1), random_gaussians(19, 1, sh_degree=2)]
    got = read_ksplat(put(ksplat_bytes(parts, 0), "a.ksplat"))
    assert got.sh_degree == 2
    np.testing.assert_array_equal(got.means, np.concatenate([part.means for part in parts]))
    np.testing.assert_array_equal(got.sh[:30, 1:4], parts[0].sh[:, 1:])
    assert not got.sh[:30, 4:].any()
    np.testing.assert_array_equal(got.sh[30:, 1:], parts[1].sh[:, 1:])


def test_ksplat_defaults_of_nought(put):
    """The range of codes and the bounds of coefficients may be left 0."""
    want = random_gaussians(30, sh_degree=1)
    content = bytearray(ksplat_bytes([want], 2))
    plain = read_ksplat(put(bytes(content), "a.ksplat"))
    content[36:44] = bytes(8)
    content[4096 + 24 : 4096 + 28] = bytes(4)
    got = read_ksplat(put(bytes(content), "a.ksplat"))
    np.testing.assert_array_equal(got.means, plain.means)
    np.testing.assert_array_equal(got.sh, plain.sh)


def patched(at: int, code: str, value: float, level: int = 2) -> bytes:
    content = bytearray(ksplat_bytes([random_gaussians(30, sh_degree=1)], level))
    struct.pack_into(code, content, at, value)
    return bytes(content)


BROKEN = {
    "another version": (lambda: patched(0, "B", 1), "version 1.1"),
    "version 0.0": (lambda: patched(1, "B", 0), "version 0.0"),
    "level 3": (lambda: patched(20, "<H", 3), "compression level 3"),
    "2^32 sections": (lambda: patched(4, "<I", 2**32 - 1), "truncated: 4294967295 sections"),
    "2^32 Gaussians": (lambda: patched(16, "<I", 2**32 - 1), "4294967295 Gaussians in the header"),
    "2^32 places": (lambda: patched(4096 + 4, "<I", 2**32 - 1), "truncated: .* bytes are missing"),
    "2^32 buckets": (lambda: patched(4096 + 12, "<I", 2**32 - 1), "truncated: .* bytes are missing"),
    "2^32 partial buckets": (lambda: patched(4096 + 36, "<I", 2**32 - 1), "truncated: .* bytes are missing"),
    "fewer places": (lambda: patched(4096 + 4, "<I", 29), "30 Gaussians in 29 places"),
    "degree 4": (lambda: patched(4096 + 40, "<H", 4), "SH degree 4"),
    "small buckets": (lambda: patched(4096 + 20, "<H", 8), "buckets of 8 bytes"),
    "no bucket": (lambda: patched(4096 + 12, "<I", 0), "beyond the 0 buckets"),
    "a partial bucket of none": (lambda: patched(5120, "<I", 0), "beyond the"),
    "the header alone": (lambda: patched(0, "B", 0)[:4000], "begins with a header of 4096"),
    "half the rows": (lambda: patched(0, "B", 0)[:-400], "truncated: 400 bytes are missing"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_of_ksplat_has_its_message(put, case):
    make, message = BROKEN[case]
    with pytest.raises(FormatError, match=message) as caught:
        read_ksplat(put(make(), "a.ksplat"))
    assert "\n" not in str(caught.value)


def test_real_files_agree(real_data):
    folder = real_data / "formats" / "splat"
    splat, ksplat = read_splat(folder / "minimal.splat"), read_ksplat(folder / "minimal.ksplat")
    assert len(splat) == 4
    assert splat.valid().all()
    np.testing.assert_allclose(splat.means, [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]])
    np.testing.assert_array_equal(ksplat.means, splat.means)
    np.testing.assert_array_equal(ksplat.sh, splat.sh)
    np.testing.assert_array_equal(ksplat.opacity_logits, splat.opacity_logits)
    np.testing.assert_allclose(covariances(ksplat), covariances(splat), atol=1e-8)
