"""The records of two web viewers: antimatter15's .splat, read and written, and mkkellogg's .ksplat, read.

A .splat is 32 bytes per Gaussian and nothing else:

    position   3 float32, world units, axes as in the PLY
    scale      3 float32, world units (not logarithms)
    colour     4 uint8: red, green, blue and opacity, as fractions of 255
    rotation   4 uint8: w x y z as (value - 128) / 128

Little endian, no header, no spherical harmonics beyond the base colour. Writers in the wild order the rows
by size times opacity, so that a viewer can show the first part; here the order is kept, because the
language field goes by rows. Source of the layout: antimatter15/splat; the code here is our own.
"""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from langsplat_core.arrays import Array, logit, sigmoid, unit
from langsplat_core.errors import malformed
from langsplat_core.io.files import atomic_path
from langsplat_core.io.hostile import open_for_reading
from langsplat_core.io.packing import to_bytes
from langsplat_core.scene import SH_COUNTS, Gaussians
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.scene.transform import C0

HUGE = 1e12  # world units that no Gaussian of a real scene has
_RECORD = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def read_splat(path: Path | str) -> Gaussians:
    """Return the Gaussians of a .splat file, of SH degree 0.

    A file cut off between two Gaussians cannot be told from a whole one. Raises InputError when the file
    cannot be opened and FormatError when it is no such file.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        if size == 0 or size % _RECORD.itemsize:
            what = f"{size} bytes are not a whole number of Gaussians of {_RECORD.itemsize}"
            raise malformed(path, what, "it is truncated or no .splat: copy it again")
        rows = np.frombuffer(file.read(size), _RECORD)
    # Nothing else in the file tells it from noise, whose floats are negative, not finite or enormous.
    with np.errstate(invalid="ignore"):
        sound = (np.abs(rows["position"]) < HUGE).all(1) & (rows["scale"] >= 0).all(1)
        sound &= (rows["scale"] < HUGE).all(1)
    if sound.mean() < 0.9:
        raise malformed(path, f"not a .splat: {(~sound).sum()} of {len(rows)} rows are no Gaussians")
    return Gaussians(
        means=rows["position"],
        log_scales=log_of_scales(rows["scale"]),
        quats_wxyz=(rows["rotation"].astype(np.float32) - 128) / 128,
        opacity_logits=logit(rows["colour"][:, 3] / 255),
        sh=base_of_colours(rows["colour"])[:, None],
    )


def write_splat(path: Path | str, gaussians: Gaussians) -> None:
    """Write the Gaussians in their order, atomically, without their view dependence.

    Colours and opacities are rounded to 1/255 (colours beyond 0..1 are cut off), rotations to 1/128 per
    component; positions and scales stay exact. A row that cannot be drawn is written with opacity 0.
    """
    valid = gaussians.valid()
    drawn = gaussians.take(valid)
    rows = np.zeros(len(gaussians), _RECORD)
    rows["position"][valid] = drawn.means
    rows["scale"][valid] = np.exp(drawn.log_scales)
    rows["colour"][valid, :3] = to_bytes((0.5 + C0 * drawn.sh[:, 0].astype(np.float64)) * 255)
    rows["colour"][valid, 3] = to_bytes(sigmoid(drawn.opacity_logits) * 255)
    rows["rotation"][valid] = to_bytes(unit(drawn.quats_wxyz.astype(np.float64)) * 128 + 128)
    with atomic_path(path) as temporary:
        temporary.write_bytes(rows.tobytes())


def base_of_colours(rgba: Array) -> Array:
    """(N, 4) uint8 colours and opacities -> (N, 3) coefficients f_dc."""
    return (rgba[:, :3] / 255 - 0.5) / C0


def log_of_scales(scales: Array) -> Array:
    """Logarithms of scales: -infinity of 0, a flat axis, and NaN of a negative one, a row dropped later."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.log(scales)


# ---- the .ksplat file of mkkellogg's GaussianSplats3D, compression levels 0, 1 and 2 ----
#
# A main header, a number of section headers (`_MAIN` and `_SECTION` give the fields that matter here), then
# the sections one after the other, everything little endian. A section holds the sizes of its partly filled
# buckets (uint32 each), the buckets, each of which begins with its centre (3 float32), and one record per
# Gaussian, sorted by bucket: position, scale, rotation w x y z, red green blue opacity (uint8), coefficients
# of degree 1, then 2, then 3, within a degree channel after channel.
#
# At level 0 all are float32. At levels 1 and 2 scales and rotations are float16, and a position is three
# uint16 codes c that mean centre + (c - range) / range * side / 2. Coefficients are float16 at level 1 and
# fractions of 255 between `sh_least` and `sh_greatest` at level 2.
#
# Source of the layout: SplatBuffer of GaussianSplats3D; the code here is our own.


def _layout(size: int, fields: dict[str, tuple[int, str]]) -> np.dtype[Any]:
    """Return the type of a record of `size` bytes; field name -> (offset, type)."""
    offsets, kinds = zip(*fields.values(), strict=True)
    return np.dtype({"names": [*fields], "formats": kinds, "offsets": offsets, "itemsize": size})


_MAIN = _layout(
    4096,
    {
        "major": (0, "u1"),
        "minor": (1, "u1"),
        "sections": (4, "<u4"),
        "gaussians": (16, "<u4"),
        "level": (20, "<u2"),
        "sh_least": (36, "<f4"),  # 0 means -1.5
        "sh_greatest": (40, "<f4"),  # 0 means 1.5
    },
)
_SECTION = _layout(
    1024,
    {
        "gaussians": (0, "<u4"),
        "places": (4, "<u4"),  # records stored, of which the first `gaussians` count
        "bucket_size": (8, "<u4"),  # Gaussians in a full bucket
        "buckets": (12, "<u4"),
        "side": (16, "<f4"),  # of a bucket's cube, world units
        "bucket_bytes": (20, "<u2"),
        "range": (24, "<u4"),  # 0 means 32767
        "full": (32, "<u4"),
        "partial": (36, "<u4"),
        "degree": (40, "<u2"),
    },
)
# Types of (position, scale and rotation, coefficient) at each compression level
_LEVELS = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))


def read_ksplat(path: Path | str) -> Gaussians:
    """Return the Gaussians of a .ksplat file in its order.

    Sections of lower SH degree are filled up with zeros.

    Raises InputError when the file cannot be opened and FormatError when it breaks a rule of the format.
    """
    path = Path(path)
    file, size = open_for_reading(path)
    with file:
        if size < _MAIN.itemsize:
            raise malformed(path, f"{size} bytes", f"a .ksplat begins with a header of {_MAIN.itemsize}")
        main = _record(file, _MAIN)
        if main["major"] != 0 or main["minor"] < 1 or main["level"] >= len(_LEVELS):
            what = f"version {main['major']}.{main['minor']}, compression level {main['level']}"
            raise malformed(path, what, "only 0.1, levels 0 to 2, is read: export the scene again")
        if file.tell() + main["sections"] * _SECTION.itemsize > size:
            raise malformed(path, f"truncated: {main['sections']} sections do not fit into {size} bytes")
        sections = [_record(file, _SECTION) for _ in range(main["sections"])]
        if sum(section["gaussians"] for section in sections) != main["gaussians"]:
            what = f"{main['gaussians']} Gaussians in the header, other numbers in its sections"
            raise malformed(path, what)
        _check_sizes(sections, main["level"], size - file.tell(), path)
        parts = [_read_section(file, section, main, path) for section in sections]
    return join_gaussians(parts)


def _record(file: BinaryIO, layout: np.dtype[Any]) -> dict[str, Any]:
    """Read one record: field name -> Python number."""
    record = np.frombuffer(file.read(layout.itemsize), layout)[0]
    return {name: record[name].item() for name in layout.names or ()}


def _check_sizes(sections: list[dict[str, Any]], level: int, left: int, path: Path) -> None:
    """FormatError for sections that the `left` bytes behind the headers cannot hold; nothing is allocated."""
    for section in sections:
        if section["degree"] not in SH_COUNTS or section["gaussians"] > section["places"]:
            what = f"{section['gaussians']} Gaussians in {section['places']} places"
            raise malformed(path, f"a section of SH degree {section['degree']}, of {what}")
        if level and section["gaussians"] and section["bucket_bytes"] < 12:
            raise malformed(path, f"buckets of {section['bucket_bytes']} bytes; expected 12, their centre")
        left -= 4 * section["partial"] + section["buckets"] * section["bucket_bytes"]
        left -= section["places"] * _gaussian(level, section["degree"]).itemsize
    if left < 0:
        raise malformed(path, f"truncated: {-left} bytes are missing")


def _gaussian(level: int, degree: int) -> np.dtype[Any]:
    position, shape, coefficient = _LEVELS[level]
    fields: list[Any] = [("position", position, 3), ("scale", shape, 3), ("rotation", shape, 4)]
    return np.dtype([*fields, ("colour", "u1", 4), ("sh", coefficient, (3 * (SH_COUNTS[degree] - 1),))])


def _read_section(file: BinaryIO, section: dict[str, Any], main: dict[str, Any], path: Path) -> Gaussians:
    level, count = main["level"], section["gaussians"]
    partial = np.frombuffer(file.read(4 * section["partial"]), "<u4")
    buckets = file.read(section["buckets"] * section["bucket_bytes"])
    layout = _gaussian(level, section["degree"])
    rows = np.frombuffer(file.read(section["places"] * layout.itemsize), layout)[:count]
    with np.errstate(invalid="ignore", over="ignore"):  # damaged numbers make rows that are dropped later
        means = rows["position"].astype(np.float64)
        if level and count:
            centres = np.frombuffer(buckets, "u1").reshape(section["buckets"], section["bucket_bytes"])
            centres = centres[:, :12].copy().view("<f4")
            code_range = section["range"] or 32767
            means = (means - code_range) / code_range * section["side"] / 2
            means += centres[_bucket_of_rows(section, partial, path)]
        rest = rows["sh"].astype(np.float64)
        if level == 2:
            least, greatest = main["sh_least"] or -1.5, main["sh_greatest"] or 1.5
            rest = least + rest / 255 * (greatest - least)
        return Gaussians(
            means=means,
            log_scales=log_of_scales(rows["scale"].astype(np.float64)),
            quats_wxyz=rows["rotation"],
            opacity_logits=logit(rows["colour"][:, 3] / 255),
            sh=np.concatenate([base_of_colours(rows["colour"])[:, None], *_by_degree(rest)], axis=1),
        )


def _bucket_of_rows(section: dict[str, Any], partial: Array, path: Path) -> Array:
    """(gaussians,) index of each row's bucket: first the full ones, then those of the sizes `partial`."""
    in_full = section["full"] * section["bucket_size"]
    row = np.arange(section["gaussians"])
    behind = np.searchsorted(np.cumsum(partial.astype(np.int64)), row - in_full, side="right")
    bucket = np.where(row < in_full, row // max(section["bucket_size"], 1), section["full"] + behind)
    if len(row) and bucket.max() >= section["buckets"]:
        raise malformed(path, f"Gaussians beyond the {section['buckets']} buckets of their section")
    return bucket


def _by_degree(rest: Array) -> list[Array]:
    """(N, 9, 24 or 45) coefficients, channel after channel within a degree -> (N, 3, 3), (N, 5, 3) ..."""
    out: list[Array] = []
    start = 0
    while start < rest.shape[1]:
        width = 3 + 2 * len(out)
        out.append(rest[:, start : start + 3 * width].reshape(-1, 3, width).transpose(0, 2, 1))
        start += 3 * width
    return out
