"""Trainings that are stopped in every stage, by a signal or a full disk, end as if nothing had been."""

import os
import random
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.progress import Report
from tests.support.photographs import colmap_reconstruction, poses, write_photos
from tests.support.processes import resize, small_disk
from tests.support.tiny_models import tiny_clip

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="no signal 9")]
LENS = PhotoIntrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
VIEWS = 6
STEPS = 5  # in which a disk is made as large as a training needs
SCENE = ("scene.ply", "scene.langsplat.safetensors", "scene.cameras.json")
SETTINGS = (
    *("--dataset.max-side", "64", "--dataset.test-every", "4", "--radiance.steps", "30"),
    *("--radiance.sh-degree", "0", "--radiance.checkpoint-every", "5", "--masks.source", "graph"),
    *("--clip.device", "cpu", "--codec.size", "9", "--phrases", "red mug", "--progress", "lines"),
)


@dataclass(frozen=True)
class Ended:
    """A process: its code, what it said besides its progress, and its stages in their order."""

    code: int
    said: str
    stages: list[str]


def train(
    data: Path, encoder: Path, folder: Path, stop: tuple[str, float] = ("", 0), number: int = signal.SIGKILL
) -> Ended:
    """Train ``folder/scene.ply``, and send a signal once a stage has come so far."""
    words = ["train", str(data), "--out", str(folder / SCENE[0]), "--clip.model", str(encoder), *SETTINGS]
    command = [sys.executable, "-m", "langsplat_core", *words]
    stages, said, sent = dict[str, None](), [], False
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        for line in process.stderr:
            try:
                report = Report.from_json(line)
            except ValueError:
                said.append(line)
                continue
            stages[report.stage] = None
            if not sent and report.stage == stop[0] and report.fraction >= stop[1]:
                process.send_signal(number)
                sent = True
        code = process.wait()
    return Ended(code, "".join(said), list(stages))


def photographs(folder: Path, kind: str) -> Path:
    """Photographs of the room, plain or with the cameras of a COLMAP model without points."""
    names = write_photos(folder / "images", LENS, poses(VIEWS))
    if kind == "COLMAP":
        (folder / "sparse" / "0").mkdir(parents=True)
        params = [LENS.fx, LENS.fy, LENS.cx, LENS.cy]
        size = (LENS.width, LENS.height)
        model = colmap_reconstruction("PINHOLE", size, params, names, poses(VIEWS))
        model.write_binary(folder / "sparse" / "0")
    return folder


def assert_same(folder: Path, whole: Path) -> None:
    for name in SCENE:
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name


@pytest.mark.parametrize("kind", ["photographs", "COLMAP"])
@pytest.mark.parametrize("how", ["killed", "signals"])
def test_training_stopped_in_every_stage_ends_with_the_same_bytes(
    how: str, kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """One run, stopped once in each stage at a random moment and begun again, against one that was not."""
    data, encoder = photographs(tmp_path / "data", kind), tmp_path / "encoder"
    tiny_clip(encoder)
    whole = train(data, encoder, tmp_path / "whole")
    assert whole.code == 0, whole.said
    seed = request.config.getoption("--seed") or 0
    choose, stopped = random.Random(seed), []
    asked = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background
        asked.append(signal.SIGINT)
    # The last stage also when it is over: then the scene is written.
    for stage, fraction in [
        *((stage, choose.random() / 2) for stage in whole.stages),
        (whole.stages[-1], 1.0),
    ]:
        number = choose.choice(asked) if how == "signals" else signal.SIGKILL
        ended = train(data, encoder, tmp_path / "stopped", (stage, fraction), number)
        expected = -number if how == "killed" else 128 + number
        assert ended.code in (0, expected), ended.said  # 0: it was faster than the signal
        assert "Traceback" not in ended.said
        if ended.code > 0:
            assert ended.said.splitlines()[-1].endswith("the same command continues where it stopped")
        stopped.append(ended.code != 0)
    print(f"{kind}: {sum(stopped)} of {len(stopped)} {how}")
    assert sum(stopped) > len(stopped) / 2
    last = train(data, encoder, tmp_path / "stopped")
    assert last.code == 0, last.said
    assert_same(tmp_path / "stopped", tmp_path / "whole")


@pytest.mark.parametrize("kind", ["photographs", "COLMAP"])
def test_training_resumes_after_full_disks(kind: str, tmp_path: Path) -> None:
    """In any stage. Each time the disk fills up it is made a little larger."""
    data, encoder = photographs(tmp_path / "data", kind), tmp_path / "encoder"
    tiny_clip(encoder)
    whole = train(data, encoder, tmp_path / "whole")
    assert whole.code == 0, whole.said
    needed = sum(path.stat().st_size for path in (tmp_path / "whole").rglob("*") if path.is_file())
    size, filled = needed // STEPS, 0
    with small_disk(tmp_path / "disk", size) as disk:
        while (ended := train(data, encoder, disk / "out")).code != 0:
            assert ended.code == 2, ended.said
            assert "No space left" in ended.said.splitlines()[-1]
            assert "Traceback" not in ended.said
            size, filled = size + needed // STEPS, filled + 1
            assert filled < 3 * STEPS  # what is written for a moment needs room too
            resize(disk, size)
        print(f"full {filled} times")
        assert filled > STEPS / 2
        assert_same(disk / "out", tmp_path / "whole")
