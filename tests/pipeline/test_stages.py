"""A work folder belongs to one training at a time, and to none once that has ended, however it ended."""

import multiprocessing
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
import torch.distributed

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.errors import InputError
from langsplat_core.pipeline.stages import LOCK, ProcessGroup, join_processes, sole_use, stage_key
from tests.support.tiny_models import tiny_room, tiny_sam

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


def test_lock_names_its_owner_and_expires_with_it(tmp_path: Path) -> None:
    work = tmp_path / "scene.work"
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(work)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
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
        assert text.strip().splitlines()[-1].count("no masks were found") == 1
        assert "Traceback" not in text
    assert not list(tmp_path.glob("two.work/radiance*"))
