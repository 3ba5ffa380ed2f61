"""Reading SuperSplat's compressed PLY."""

import numpy as np
import pytest

from langsplat_core.arrays import rotation_matrices, sigmoid
from langsplat_core.errors import FormatError
from langsplat_core.io import read_ply
from tests.support.file_samples import C0, SHARED_DATA, compressed_ply
from tests.support.scenes import random_gaussians

GUITAR = SHARED_DATA / "gaussians" / "guitar.compressed.ply"


@pytest.fixture
def put(tmp_path):
    def write(content: bytes):
        path = tmp_path / "scene.compressed.ply"
        path.write_bytes(content)
        return path

    return write


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("colours", [True, False])
def test_decoding_is_exact_up_to_the_quantisation(put, degree, colours):
    want = random_gaussians(600, sh_degree=degree)  # two chunks and a part of one
    got = read_ply(put(compressed_ply(want, colours=colours)))
    assert len(got) == 600
    assert got.sh_degree == degree
    # Half a step of the coarsest field, with bounds over at most the whole scene; 10 % for float32.
    for name, bits in (("means", 10), ("log_scales", 10)):
        step = np.ptp(getattr(want, name), axis=0) / (2**bits - 1)
        assert (np.abs(getattr(got, name) - getattr(want, name)) <= 0.55 * step).all()
    step = (np.ptp(want.sh[:, 0], axis=0) if colours else 1 / C0) / 255
    if not colours:  # without bounds the colours are 0..1
        want.sh[:, 0] = (np.clip(0.5 + C0 * want.sh[:, 0], 0, 1) - 0.5) / C0
    assert (np.abs(got.sh[:, 0] - want.sh[:, 0]) <= 0.55 * step).all()
    assert np.abs(sigmoid(got.opacity_logits) - sigmoid(want.opacity_logits)).max() <= 0.5 / 255 + 1e-6
    # 10 bits over [-0.71, 0.71]: 7e-4 a component, amplified at most 2.5 times in the matrix and in the
    # component that is reconstructed
    turned = rotation_matrices(got.quats_wxyz.astype(float)) - rotation_matrices(
        want.quats_wxyz.astype(float)
    )
    assert np.abs(turned).max() <= 6e-3
    if degree:
        # 8 bits over [-4, 4]: half a step is 1/64
        assert np.abs(got.sh[:, 1:] - want.sh[:, 1:]).max() <= 1 / 64 + 1e-6


def test_the_first_and_last_bits_of_every_field(put):
    """A file made of literal words, with the numbers worked out by hand."""
    header = ["ply", "format binary_little_endian 1.0", "element chunk 1"]
    header += [f"property float {end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    header += [f"property float {end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    header += ["element vertex 4"]
    header += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    bounds = np.array([[0, 10, 20, 1, 20, 40, -9, -8, -7, -1, -2, -3]], "<f4")
    half = 0b1000000000  # 512 of 1023: 0.0005 above the middle
    words = np.array(
        [
            [0, 0b00 << 30 | half << 20 | half << 10 | half, 0, 0x00000000],
            [2047 << 21, 0b01 << 30 | half << 20 | half << 10 | half, 2047 << 21, 0xFF000000],
            [1023 << 11, 0b10 << 30 | half << 20 | half << 10 | half, 1023 << 11, 0x00FF00FF],
            [2047, 0b11 << 30 | 1023 << 20 | half << 10 | half, 2047, 0x0000FF80],
        ],
        "<u4",
    )
    body = bounds.tobytes() + words.tobytes()
    got = read_ply(put(("\n".join(header) + "\nend_header\n").encode() + body))
    np.testing.assert_allclose(got.means, [[0, 10, 20], [1, 10, 20], [0, 20, 20], [0, 10, 40]])
    np.testing.assert_allclose(got.log_scales, [[-9, -8, -7], [-1, -8, -7], [-9, -2, -7], [-9, -8, -3]])
    np.testing.assert_allclose(got.quats_wxyz[:3], np.eye(4)[:3], atol=1e-3)
    np.testing.assert_allclose(got.quats_wxyz[3], [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-3)
    np.testing.assert_allclose(
        0.5 + C0 * got.sh[:, 0], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-6
    )
    assert got.opacity_logits[0] == got.opacity_logits[1] == -np.inf
    assert got.opacity_logits[2] == np.inf
    np.testing.assert_allclose(sigmoid(got.opacity_logits[3]), 128 / 255, rtol=1e-6)


BROKEN = {
    "too few chunks": (b"element chunk 3\n", b"element chunk 2\n", "2 chunks for 600 Gaussians"),
    "a bound missing": (b"float max_y\n", b"float ceiling\n", "without the number 'max_y' in element chunk"),
    "a word missing": (b"uint packed_scale\n", b"uint size\n", "without the number 'packed_scale'"),
    "a list of bounds": (b"float max_y\n", b"list uchar float max_y\n", "without the number 'max_y'"),
    "coefficients of fewer": (b"element sh 600\n", b"element sh 599\n", "element sh has 599 rows of 9"),
    "a coefficient missing": (b"property uchar f_rest_8\n", b"", "element sh has 600 rows of 8"),
    "coefficients of floats": (b"uchar f_rest_3", b"char f_rest_3", "beyond 0..255"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(put, case):
    old, new, message = BROKEN[case]
    content = compressed_ply(random_gaussians(600, sh_degree=1))
    assert old in content
    with pytest.raises(FormatError, match=message):
        read_ply(put(content.replace(old, new)))


def test_truncated(put):
    content = compressed_ply(random_gaussians(600, sh_degree=1))
    for lost in (1, 600 * 9 + 1, 600 * (9 + 16) + 1):
        with pytest.raises(FormatError, match="truncated"):
            read_ply(put(content[:-lost]))


def test_infinite_bounds_make_rows_that_are_dropped(put):
    content = compressed_ply(random_gaussians(300))
    start = content.index(b"end_header\n") + len(b"end_header\n")
    content = content[:start] + np.float32(np.inf).tobytes() + content[start + 4 :]
    got = read_ply(put(content))
    assert not got.valid()[:256].any()
    assert got.valid()[256:].all()


@pytest.mark.skipif(not GUITAR.exists(), reason="the shared data are not here")
def test_a_real_file():
    got = read_ply(GUITAR)
    assert len(got) == 90854
    assert got.valid().all()
    assert np.isposinf(got.opacity_logits).sum() == 667
    scales = np.exp(got.log_scales.astype(np.float64))
    assert 2.4e7 < (scales.max(1) / scales.min(1)).max() < 2.6e7
    np.testing.assert_allclose(np.linalg.norm(got.quats_wxyz, axis=1), 1, atol=1e-6)
    assert ((0.5 + C0 * got.sh[:, 0]) > -0.5).all()
