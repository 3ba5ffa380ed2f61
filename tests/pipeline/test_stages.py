"""A work folder belongs to one training at a time, and to none once that has ended, however it ended."""

import multiprocessing
import os
import random
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch.distributed

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from langsplat_core.errors import FormatError, InputError
from langsplat_core.pipeline.stages import LOCK, ProcessGroup, join_processes, kept, sole_use, stage_key
from langsplat_core.progress import Report
from tests.support.photographs import poses, write_model, write_photos
from tests.support.processes import resize, small_disk
from tests.support.tiny_models import tiny_clip, tiny_room, tiny_sam

pytestmark = pytest.mark.long

HOLD = (
    "import sys, time\nfrom pathlib import Path\nfrom langsplat_core.pipeline.stages import sole_use\n"
    "with sole_use(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n"
)


def test_stage_key_names_stage_version_and_inputs() -> None:
    keys = {stage_key(*parts) for parts in (("lift", 2, "a"), ("lift", 3, "a"), ("fit", 2, "a"))}
    keys.add(stage_key("lift", 2, "b"))
    assert len(keys) == 4
    assert stage_key("lift", 2, "a") in keys


def test_stored_arrays_that_changed_are_refused(tmp_path: Path) -> None:
    made = {"a": np.arange(6.0).reshape(2, 3), "b": np.zeros(0, np.int32)}
    path = tmp_path / "stage.npz"
    kept(path, lambda: made)
    found = kept(path, dict)
    assert {name: array.tolist() for name, array in found.items()} == {n: a.tolist() for n, a in made.items()}
    for arrays in ({**np.load(path), "a": made["a"][:1]}, made):  # another one, and without a digest
        np.savez(path, **arrays)
        with pytest.raises(FormatError, match="changed since"):
            kept(path, dict)


def test_lock_names_its_owner_and_expires_with_it(tmp_path: Path) -> None:
    work = tmp_path / "scene.work"
    command = [sys.executable, "-c", HOLD, str(work)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=f"process {other.pid} on .*--work"), sole_use(work):
            pass
        other.kill()  # -9: it can tidy nothing up
        other.wait()
        assert (work / LOCK).exists()
        with sole_use(work):
            assert (work / LOCK).read_text().startswith(f"process {os.getpid()} ")


def test_lock_excludes_a_second_training_in_one_process(tmp_path: Path) -> None:
    work = tmp_path / "c"
    for _ in range(2):
        with sole_use(work), pytest.raises(InputError, match="--work"), sole_use(work):
            pass
    with sole_use(tmp_path / "a"), sole_use(tmp_path / "b"):
        (tmp_path / "a" / "result").touch()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", LOCK, "result"]  # b held nothing


# Several processes that share one training: the same scene as from one.

OPTIONS = (
    *("--dataset.max-side", "64", "--dataset.test-every", "4", "--radiance.steps", "20"),
    *("--radiance.sh-degree", "0", "--masks.source", "graph", "--clip.device", "cpu", "--codec.size", "20"),
)


def test_every_item_is_shared_once(monkeypatch):
    items = list(range(11))
    shares = [ProcessGroup(rank, 3).share(items) for rank in range(3)]
    assert sorted(item for share in shares for item in share) == items
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert [ProcessGroup(rank, 3).is_main for rank in range(3)] == [True, False, False]
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert join_processes() == ProcessGroup(0, 1)  # without a launcher


def test_barrier_names_a_lost_process(monkeypatch):
    def lost() -> None:
        raise RuntimeError("Connection closed by peer [127.0.0.1]:55\nmore")

    monkeypatch.setattr("torch.distributed.barrier", lost)
    with pytest.raises(InputError, match=r"ended \(Connection closed by peer .*what is finished is kept"):
        ProcessGroup(1, 2).barrier()


def train(room: Path, out: Path, said: Path, surroundings: dict[str, str], *more: str) -> None:
    """The command, in an environment; its exit code becomes this process's, unless it is 0."""
    os.environ.update(surroundings)
    words = ["train", str(room), "--out", str(out), "--phrases", "red mug", *OPTIONS, *more]
    with said.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        code = main("langsplat", lambda: parse([*words, "--clip.model", str(room / "encoder")]))
    if code:
        sys.exit(code)


def train_by_two(room: Path, out: Path, *more: str) -> tuple[list[int | None], list[str]]:
    """Exit codes and what is said, joined as torchrun joins them: it keeps the store where they meet."""
    store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    there = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port), "WORLD_SIZE": "2"}
    there["TORCHELASTIC_USE_AGENT_STORE"] = "True"
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.pipeline.test_stages"])
    two, said = [], [out.with_name("0.txt"), out.with_name("1.txt")]
    for rank, text in enumerate(said):
        surroundings = there | {"RANK": str(rank), "LOCAL_RANK": str(rank)}
        arguments = (room, out, text, surroundings, *more)
        two.append(processes.Process(target=train, args=arguments, daemon=True))
    for process in two:
        process.start()
    for process in two:
        process.join(300)
    return [process.exitcode for process in two], [text.read_text() for text in said]


def test_two_processes_make_the_scene_of_one(tmp_path: Path) -> None:
    room = tiny_room(tmp_path / "room")
    train(room, tmp_path / "one.ply", tmp_path / "one.txt", {})
    codes, texts = train_by_two(room, tmp_path / "two.ply")
    assert codes == [0, 0], texts
    assert [text.count("Gaussians from 5 photographs") for text in texts] == [1, 0]
    for suffix in (".ply", ".langsplat.safetensors"):
        assert (tmp_path / f"two{suffix}").read_bytes() == (tmp_path / f"one{suffix}").read_bytes()


def test_two_processes_without_a_mask_both_end_before_training(tmp_path: Path) -> None:
    room = tiny_room(tmp_path / "room")
    tiny_sam(tmp_path / "sam")  # random weights, whose scores are far below one
    picky = ("--masks.source", "sam", "--masks.sam", str(tmp_path / "sam"), "--masks.predicted-iou", "1")
    codes, texts = train_by_two(room, tmp_path / "two.ply", *picky)
    assert codes == [2, 2], texts
    for text in texts:
        assert text.strip().splitlines()[-1].count("no photograph has masks") == 1
        assert "Traceback" not in text
    assert not list(tmp_path.glob("two.work/radiance*"))


# Trainings that are stopped in every stage, by a signal or a full disk, end as if nothing had been.

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


def train_until(
    data: Path, encoder: Path, folder: Path, stop: tuple[str, float] = ("", 0), number: int = signal.SIGKILL
) -> Ended:
    """Train ``folder/scene.ply``, and send a signal once a stage has come so far."""
    words = ["train", str(data), "--out", str(folder / SCENE[0]), "--clip.model", str(encoder), *SETTINGS]
    command = [sys.executable, "-m", "langsplat_core", *words]
    stages, said, sent = dict[str, None](), [], False
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as process:
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
    return Ended(process.wait(), "".join(said), list(stages))


def photographs(folder: Path, kind: str) -> Path:
    """Photographs of the room, plain or with the cameras of a COLMAP model without points."""
    names = write_photos(folder / "images", LENS, poses(VIEWS))
    if kind == "COLMAP":
        write_model(folder / "sparse" / "0", LENS, names, poses(VIEWS))
    return folder


def assert_same(folder: Path, whole: Path) -> None:
    for name in SCENE:
        assert (folder / name).read_bytes() == (whole / name).read_bytes(), name


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no signal 9")
@pytest.mark.parametrize("kind", ["photographs", "COLMAP"])
@pytest.mark.parametrize("how", ["killed", "signals"])
def test_training_stopped_in_every_stage_ends_with_the_same_bytes(how, kind, tmp_path, request):
    """One run, stopped once in each stage at a random moment and begun again, against one that was not."""
    data, encoder = photographs(tmp_path / "data", kind), tmp_path / "encoder"
    tiny_clip(encoder)
    whole = train_until(data, encoder, tmp_path / "whole")
    assert whole.code == 0, whole.said
    seed = request.config.getoption("--seed") or 0
    choose, stopped = random.Random(seed), []
    asked = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) != signal.SIG_IGN:  # as in a shell's background
        asked.append(signal.SIGINT)
    # The last stage also when it is over: then the scene is written.
    moments = [(stage, choose.random() / 2) for stage in whole.stages]
    for stage, fraction in [*moments, (whole.stages[-1], 1.0)]:
        number = choose.choice(asked) if how == "signals" else signal.SIGKILL
        ended = train_until(data, encoder, tmp_path / "stopped", (stage, fraction), number)
        expected = -number if how == "killed" else 128 + number
        assert ended.code in (0, expected), ended.said  # 0: it was faster than the signal
        assert "Traceback" not in ended.said
        if ended.code > 0:
            assert ended.said.splitlines()[-1].endswith("the same command goes on from what was finished")
        stopped.append(ended.code != 0)
    print(f"{kind}: {sum(stopped)} of {len(stopped)} {how}")
    assert sum(stopped) > len(stopped) / 2
    last = train_until(data, encoder, tmp_path / "stopped")
    assert last.code == 0, last.said
    assert_same(tmp_path / "stopped", tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no signal 9")
@pytest.mark.parametrize("kind", ["photographs", "COLMAP"])
def test_training_resumes_after_full_disks(kind: str, tmp_path: Path) -> None:
    """In any stage. Each time the disk fills up it is made a little larger."""
    data, encoder = photographs(tmp_path / "data", kind), tmp_path / "encoder"
    tiny_clip(encoder)
    whole = train_until(data, encoder, tmp_path / "whole")
    assert whole.code == 0, whole.said
    needed = sum(path.stat().st_size for path in (tmp_path / "whole").rglob("*") if path.is_file())
    size, filled = needed // STEPS, 0
    with small_disk(tmp_path / "disk", size) as disk:
        while (ended := train_until(data, encoder, disk / "out")).code != 0:
            assert ended.code == 2, ended.said
            assert "No space left" in ended.said.splitlines()[-1]
            assert "Traceback" not in ended.said
            size, filled = size + needed // STEPS, filled + 1
            assert filled < 3 * STEPS  # what is written for a moment needs room too
            resize(disk, size)
        print(f"full {filled} times")
        assert filled > STEPS / 2
        assert_same(disk / "out", tmp_path / "whole")
