"""The .spz file of Niantic: quantised Gaussians, about ten times smaller than the PLY.

    positions   three 24-bit fixed-point numbers; the header says how many bits are behind the point
                (version 1: three float16)
    alphas      opacity in 8 bits
    colours     0.5 + 0.15 f_dc in 8 bits each
    scales      16 (logarithm + 10) in 8 bits each
    rotations   from version 3 on: 2 bits for which of x y z w is largest and left out (it is positive),
                and a sign and 9 bits of magnitude over sqrt(1/2) for each of the others; before: x y z in 8
                bits over [-1, 1] each (w is positive)
    sh          128 + 128 times the coefficient, red green blue of one coefficient after the other

The axes are right, up, back (RUB), unless the file says otherwise: half a turn about x from the axes of
the PLY, which changes signs of positions, of quaternions and of coefficients. What is read are versions 1
to 4; degree 4, which nothing here can draw, is left out.

Version 3 is written. Its rotations are exact to 0.1 degrees where those of version 2 err by up to a degree,
and every program that reads the newer version 4 reads it too, while many that read it do not know 4, which
differs in the container alone. Source: nianticlabs/spz; the code here is our own.
"""

from pathlib import Path

import numpy as np

from langsplat_core.arrays import Array, logit, sigmoid, unit
from langsplat_core.errors import InputError
from langsplat_core.formats.compressed_ply import smallest_three
from langsplat_core.formats.splat import to_bytes
from langsplat_core.formats.spz_container import AXES_RUB, Packed, read_packed, write_packed
from langsplat_core.scene import SH_COUNTS, Gaussians, Scene

COLOUR_SCALE = 0.15
FRACTIONAL_BITS = 12  # what other writers use: steps of 1/4096, up to 2048
# Whether each spherical harmonic from degree 1 on is odd in x, y, z
_ODD = np.array(
    [
        *([0, 1, 0], [0, 0, 1], [1, 0, 0]),
        *([1, 1, 0], [0, 1, 1], [0, 0, 0], [1, 0, 1], [0, 0, 0]),
        *([0, 1, 0], [1, 1, 1], [0, 1, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1], [1, 0, 0]),
    ],
    dtype=bool,
)


def read_spz_scene(path: Path | str) -> Scene:
    """The Gaussians of a .spz file, and whether they are to be drawn antialiased.

    Raises InputError when the file cannot be opened and FormatError when it breaks a rule of the format.
    """
    packed = read_packed(Path(path))
    blocks, signs = packed.blocks, _signs_to_rdf(packed.axes)
    count, degree = len(blocks["alphas"]), min(packed.sh_degree, 3)
    rest = blocks["sh"].reshape(count, blocks["sh"].shape[1] // 3, 3)[:, : SH_COUNTS[degree] - 1]
    rest = (rest.astype(np.float32) - 128) / 128 * _coefficient_signs(signs, rest.shape[1])[:, None]
    base = (blocks["colours"] / 255 - 0.5) / COLOUR_SCALE
    with np.errstate(invalid="ignore"):  # signalling NaN in half floats become ordinary ones
        means = _positions(packed) * signs
    gaussians = Gaussians(
        means=means,
        log_scales=blocks["scales"].astype(np.float32) / 16 - 10,
        quats_wxyz=_rotations(packed) * _quaternion_signs(signs),
        opacity_logits=logit(blocks["alphas"][:, 0] / 255),
        sh=np.concatenate([base[:, None], rest], axis=1),
    )
    return Scene(gaussians, antialiased=packed.antialiased)


def write_spz(path: Path | str, gaussians: Gaussians, antialiased: bool = False) -> None:
    """Write .spz version 3, atomically; rows keep their order.

    Positions are rounded to 1/4096 world unit, or finer where the Gaussians are smaller than that; scales
    to 1/16 in the logarithm, within e^-10 to e^5.9; coefficients to 1/128, within -1 to 1 (other
    writers round them to 1/16 and 1/8, for still smaller files); colours and opacities to 1/255. A row that
    cannot be drawn is written with opacity 0. Raises InputError for a scene so large that 24 bits cannot tell
    its positions apart.
    """
    valid = gaussians.valid()
    drawn = gaussians.take(valid)
    bits = _fractional_bits(drawn, Path(path))
    signs = _signs_to_rdf(AXES_RUB)  # half a turn, its own inverse
    codes = np.rint(drawn.means.astype(np.float64) * signs * 2.0**bits).astype("<i4")
    rest = drawn.sh[:, 1:] * _coefficient_signs(signs, drawn.sh.shape[1] - 1)[:, None]
    coded = {
        "positions": codes[..., None].view(np.uint8)[..., :3].reshape(-1, 9),
        "alphas": to_bytes(sigmoid(drawn.opacity_logits) * 255)[:, None],
        "colours": to_bytes((drawn.sh[:, 0] * COLOUR_SCALE + 0.5) * 255),
        "scales": to_bytes((drawn.log_scales + 10) * 16),
        "rotations": _rotation_codes(drawn.quats_wxyz * _quaternion_signs(signs)),
        "sh": to_bytes(rest.reshape(len(rest), 3 * rest.shape[1]) * 128 + 128),
    }
    blocks = {name: np.zeros((len(valid), code.shape[1]), np.uint8) for name, code in coded.items()}
    for name, code in coded.items():
        blocks[name][valid] = code
    write_packed(path, Packed(3, gaussians.sh_degree, bits, antialiased, AXES_RUB, blocks))


def _fractional_bits(drawn: Gaussians, path: Path) -> int:
    """As many as other writers use, more for a small scene, fewer for a large one."""
    if len(drawn) == 0:
        return FRACTIONAL_BITS
    reach = max(float(np.abs(drawn.means).max()), 1e-30)
    most = int(np.floor(np.log2((2**23 - 1) / reach)))
    size = float(np.median(drawn.log_scales.max(axis=1)))  # logarithm of a typical Gaussian's longest axis
    least = int(np.ceil(-size / np.log(2))) if np.isfinite(size) else 0  # a step of its size
    if most < min(least, FRACTIONAL_BITS):
        raise InputError(
            f"{path}: positions up to {reach:.3g} of Gaussians as small as {np.exp(size):.3g} are beyond the "
            "24 bits of .spz; write .ply, or crop what lies far off"
        )
    # The median Gaussian keeps its place to a sixteenth of its size. 24 bits hold the scene, and beyond
    # 30 bits behind the point other readers overflow.
    return max(0, min(most, max(FRACTIONAL_BITS, least + 4), 30))


def _positions(packed: Packed) -> Array:
    """(N, 3) along the axes of the file."""
    data = packed.blocks["positions"]
    if packed.version == 1:
        return np.ascontiguousarray(data).view("<f2").astype(np.float32)
    parts = data.reshape(len(data), 3, 3)
    codes = (
        parts[..., 0]
        | parts[..., 1].astype(np.int32) << 8
        | parts[..., 2].astype(np.int8).astype(np.int32) << 16
    )
    return codes / 2.0**packed.fractional_bits


def _rotations(packed: Packed) -> Array:
    """(N, 4) unit quaternions w x y z."""
    data = packed.blocks["rotations"]
    if packed.version < 3:
        xyz = data / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1, keepdims=True)))
        return np.concatenate([w, xyz], axis=1)
    words = np.ascontiguousarray(data).view("<u4")[:, 0]
    three = np.stack([words >> shift & 1023 for shift in (20, 10, 0)], axis=1)
    magnitudes = (three & 511) / 511 * np.sqrt(0.5)
    xyzw = smallest_three(np.where(three & 512, -magnitudes, magnitudes), words >> 30)
    return xyzw[:, [3, 0, 1, 2]]


def _rotation_codes(quats_wxyz: Array) -> Array:
    """(N, 4) quaternions of any length -> (N, 4) bytes of version 3."""
    xyzw = unit(quats_wxyz.astype(np.float64), 1e-30)[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    words = largest.astype(np.uint32)
    xyzw *= np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    codes = np.rint(np.abs(xyzw) * np.sqrt(2) * 511).clip(0, 511).astype(np.uint32) | (xyzw < 0) * np.uint32(
        512
    )
    for component in range(4):
        words = np.where(component == largest, words, words << np.uint32(10) | codes[:, component])
    return words.astype("<u4")[:, None].view(np.uint8)


def _signs_to_rdf(axes: int) -> Array:
    """(3,) 1 or -1: what turns coordinates of a file into right, down, front, those of the PLY. `axes` - 1
    has a bit each for right, up, front."""
    right, up, front = (axes - 1 >> bit & 1 for bit in range(3))
    return np.array([1 if right else -1, -1 if up else 1, 1 if front else -1])


def _quaternion_signs(signs: Array) -> Array:
    """Of w x y z: mirroring an axis turns the two rotations about the others round."""
    return np.array([1, signs[1] * signs[2], signs[0] * signs[2], signs[0] * signs[1]])


def _coefficient_signs(signs: Array, count: int) -> Array:
    """(count,) of the coefficients from degree 1 on."""
    return np.where(_ODD, signs, 1).prod(axis=1)[:count]
