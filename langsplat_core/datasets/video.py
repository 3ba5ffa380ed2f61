"""Photographs from a video: the sharpest image of every interval."""

import errno
import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.datasets.colour import HLG, PQ, UNSPECIFIED, to_srgb
from langsplat_core.datasets.sfm import MIN_PHOTOS
from langsplat_core.errors import FormatError, InputError, Tell, optional_imports, printable_line, report_loss
from langsplat_core.io.files import shown
from langsplat_core.io.hostile import MOST_PIXELS, open_for_reading
from langsplat_core.progress import Progress, silent

# The content chooses the demuxer: of text it may be one that asks the network, or reads other files.
ALLOWED = {"format_whitelist": "mov,matroska,avi,mpegts", "protocol_whitelist": "file"}


@optional_imports()
def kept_frames(video: Path, count: int, work: Path, progress: Progress = silent) -> Path:
    """Return the folder in `work` with the sharpest image of each of `count` equal spans of a video's time.

    They are frame_0001.jpg ..., turned as the video is shown; spans without an image are left out. Raises
    InputError where too little is left, FormatError for a file that cannot be read as a video.
    """
    file, _ = open_for_reading(video)
    with file:
        content = hashlib.file_digest(file, "sha256").hexdigest()[:12]  # type: ignore[arg-type]
    folder = work / f"frames-{content}-{count}-srgb"  # earlier ones have other colours
    if folder.is_dir():
        return folder
    import av

    unfinished = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        with open_for_reading(video)[0] as file, av.open(file, "r", options=dict(ALLOWED)) as container:
            written = _write(container, unfinished, count, progress)
        if written < MIN_PHOTOS:
            raise InputError(f"{shown(video)}: has {written} images; at least {MIN_PHOTOS} are needed")
        unfinished.rename(folder)
    # Damaged data, no stream of images, sizes that cannot be, or a place to read at that cannot be.
    except (av.FFmpegError, OSError, IndexError, ValueError, MemoryError) as error:
        plain = isinstance(error, OSError) and not isinstance(error, av.FFmpegError)
        if plain and getattr(error, "errno", 0) != errno.EINVAL:
            raise  # of the disk
        reason = printable_line(getattr(error, "strerror", None) or error, 80)
        if getattr(error, "errno", 0) == errno.EINVAL:
            reason = "damaged, or neither MP4, MOV, MKV, WebM, AVI nor TS"
        raise FormatError(f"{shown(video)}: not a readable video ({reason}); copy it again") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return folder


def _write(container: Any, folder: Path, count: int, progress: Progress) -> int:
    """Write the sharpest images of an opened video; return their number."""
    stream = container.streams.video[0]
    if stream.codec_context is None:
        raise ValueError("of an unknown codec")
    stream.thread_type = "AUTO"
    if stream.codec_context.width * stream.codec_context.height > MOST_PIXELS:
        raise ValueError(f"{stream.codec_context.width}x{stream.codec_context.height} pixels")
    packets = container.demux(stream)
    times = [float(packet.pts * packet.time_base) for packet in packets if packet.pts is not None]
    if not times:
        raise ValueError("it has no images")
    first, last = min(times), max(times)
    container.seek(0)
    best: dict[int, tuple[float, Any]] = {}  # span -> sharpness and image, of the span under way
    aspect = float(stream.sample_aspect_ratio or 1)
    if not 0.25 <= aspect <= 4:
        raise ValueError(f"pixels of {stream.sample_aspect_ratio}")
    told: set[str] = set()
    for frame in _decoded(container, stream, told.add):
        time = first if frame.time is None else float(frame.time)
        share = (time - first) / max(last - first, 1e-9)
        span = min(int(share * count), count - 1)
        for done in [number for number in best if number < span]:
            _save(best.pop(done)[1], aspect, folder, told.add)
        progress("taking photographs out of the video", min(share, 1.0))
        sharp = sharpness(frame)
        if span not in best or sharp > best[span][0]:
            best[span] = (sharp, frame)
    for _, frame in best.values():
        _save(frame, aspect, folder, told.add)
    for what in sorted(told):
        report_loss("%s: %s", container.name, what)
    return len(list(folder.iterdir()))


def _decoded(container: Any, stream: Any, tell: Tell) -> Iterator[Any]:
    """Yield every image that can be decoded: a recording that broke off has a last one that cannot."""
    import av

    for packet in container.demux(stream):
        try:
            yield from packet.decode()
        except av.InvalidDataError:
            tell("some of its images cannot be decoded and are left out")


def sharpness(frame: Any) -> float:
    """Return the variance of the Laplacian of the grey image, 640 px wide: below noise, above blur."""
    width = min(640, frame.width)
    height = max(1, round(frame.height * width / frame.width))
    grey: Array = frame.reformat(width=width, height=height, format="gray").to_ndarray().astype(np.float32)
    if min(grey.shape) < 3:
        return 0.0
    around = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:]
    return float((around - 4 * grey[1:-1, 1:-1]).var())


def _save(frame: Any, aspect: float, folder: Path, tell: Tell) -> None:
    """Write an image as it is shown under the next number; aspect: of its pixels, width over height."""
    from av.video.reformatter import Colorspace, Interpolation

    deep = frame.color_trc in (HLG, PQ)  # whose dark shades need more than 8 bits
    # HD without a stated colour space is BT.709, smaller images BT.601, as players take them.
    hd = frame.colorspace == UNSPECIFIED and max(frame.width / 16, frame.height / 9) >= 80
    shown = frame.reformat(
        width=round(frame.width * max(aspect, 1)),
        height=round(frame.height / min(aspect, 1)),
        format="rgb48le" if deep else "rgb24",
        src_colorspace=Colorspace.ITU709 if hd else None,
        interpolation=Interpolation.BICUBIC,
    )
    pixels = to_srgb(shown.to_ndarray(), frame.color_trc, frame.color_primaries, tell)
    upright = np.rot90(pixels, round(frame.rotation / 90))
    name = f"frame_{len(list(folder.iterdir())) + 1:04d}.jpg"
    Image.fromarray(np.ascontiguousarray(upright)).save(folder / name, quality=95)
