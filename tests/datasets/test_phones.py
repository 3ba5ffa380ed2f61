"""What phones make: HEIC photographs and videos."""

import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.datasets.exif import optics
from langsplat_core.datasets.photos import read_photo
from langsplat_core.datasets.video import extract_frames, kept_frames, sharpness
from langsplat_core.errors import FormatError, InputError, LangSplatError
from langsplat_core.io.hostile import PictureError, is_video
from langsplat_core.progress import WorkCancelledError
from tests.support.processes import stop_at

av = pytest.importorskip("av")
pillow_heif = pytest.importorskip("pillow_heif")

WIDTH, HEIGHT = 96, 64


def scene(step: int, blur: float = 0.0) -> Array:
    """(H, W, 3) uint8: plain stripes that wander, red above and blue below."""
    from scipy.ndimage import gaussian_filter

    image = np.zeros((HEIGHT, WIDTH, 3))
    image[: HEIGHT // 2, :, 0] = image[HEIGHT // 2 :, :, 2] = 200
    image[:, (np.arange(WIDTH) + step) % 12 < 4] += 50
    return gaussian_filter(image, (blur, blur, 0)).astype(np.uint8)


def write_video(path: Path, images: list[Array], rate: int = 10) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=rate)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.bit_rate = 4_000_000
        for image in images:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


@pytest.fixture
def clip(tmp_path: Path) -> Path:
    """Four seconds; every fifth image is sharp, the others are blurred."""
    return write_video(tmp_path / "clip.mp4", [scene(k, 0.0 if k % 5 == 2 else 2.0) for k in range(40)])


def test_the_sharpest_image_of_every_part_is_taken(clip: Path, tmp_path: Path) -> None:
    written = extract_frames(clip, tmp_path / "out", 8)
    assert [path.name for path in written] == [f"frame_{k:04d}.jpg" for k in range(1, 9)]
    for path, step in zip(written, range(2, 40, 5), strict=True):
        image = np.asarray(Image.open(path)).astype(int)
        errors = [abs(image - scene(k, 0.0 if k % 5 == 2 else 2.0)).mean() for k in range(40)]
        assert errors[step] < 8
        assert errors[step] < min(error for k, error in enumerate(errors) if k % 5 != 2)


def test_fewer_images_than_parts_are_all_taken(tmp_path: Path) -> None:
    video = write_video(tmp_path / "short.mov", [scene(3 * k) for k in range(5)])
    assert len(extract_frames(video, tmp_path / "out", 100)) == 5


def test_sharpness_falls_with_blur_and_stands_tiny_images():
    sharp = [sharpness(av.VideoFrame.from_ndarray(scene(0, blur), format="rgb24")) for blur in (0, 0.7, 2)]
    assert sharp[0] > 2 * sharp[1] > 4 * sharp[2] > 0
    assert sharpness(av.VideoFrame.from_ndarray(np.zeros((2, 2, 3), np.uint8), format="rgb24")) == 0


def test_work_folder_keeps_whole_sets_of_frames_alone(clip: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    with pytest.raises(WorkCancelledError):
        kept_frames(clip, 6, work, stop_at("taking photographs out of the video"))
    assert not list(work.iterdir())
    folder = kept_frames(clip, 6, work)
    stamps = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert kept_frames(clip.rename(tmp_path / "renamed.MP4"), 6, work) == folder
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == stamps
    assert is_video(tmp_path / "renamed.MP4")
    assert not is_video(tmp_path)


def test_damaged_videos_end_in_a_line_or_give_what_can_be_read(clip: Path, tmp_path: Path) -> None:
    content, read = clip.read_bytes(), 0
    rng = np.random.default_rng(5)
    for case in range(40):
        data = bytearray(content)
        for _ in range(1 + case % 20):
            data[rng.integers(len(data))] = rng.integers(256)
        video = tmp_path / "damaged.mp4"
        video.write_bytes(data[: int(len(data) * rng.uniform(0.2, 1))] if case % 3 == 0 else data)
        with suppress(LangSplatError):  # and nothing else
            extract_frames(video, tmp_path / f"out{case}", 5)
            read += 1
        assert not list(tmp_path.glob("*.part"))
    assert len(list(tmp_path.glob("out*"))) == read
    assert read > 0


@pytest.mark.parametrize("content", [b"", b"no video at all" * 50])
def test_other_files_are_no_videos(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(FormatError, match=r"a\.mp4: not a readable video"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "out", 5)
    with pytest.raises(InputError, match="no such file"):
        extract_frames(tmp_path / "b.mp4", tmp_path / "out", 5)


def test_frames_are_not_written_over(clip: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="holds something already"):
        extract_frames(clip, tmp_path, 5)
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_heic_is_a_photograph(tmp_path: Path) -> None:
    pillow_heif.register_heif_opener()
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.fromarray(scene(0)).save(tmp_path / "a.heic", exif=exif, quality=95)
    assert abs(np.asarray(read_photo(tmp_path / "a.heic", True)).astype(int) - scene(0)).mean() < 6
    assert dict(optics(tmp_path / "a.heic").get_ifd(0x8769)) == {0xA405: 28}


def test_without_its_codec_heic_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pillow_heif.register_heif_opener()
    Image.fromarray(scene(0)).save(tmp_path / "a.heic")
    monkeypatch.delitem(Image.OPEN, "HEIF")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(PictureError, match=r"HEIC needs pillow-heif: pip install .*\[phones\]"):
        read_photo(tmp_path / "a.heic", True)
