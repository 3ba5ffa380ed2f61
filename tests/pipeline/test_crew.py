"""Several processes that share one training: the same scene as from one."""

import subprocess
import sys
from pathlib import Path

import pytest

from langsplat_core.errors import InputError
from langsplat_core.pipeline.crew import Crew, join_crew
from langsplat_core.pipeline.views import StoredViews
from tests.support.lifting import make_views
from tests.support.tiny_room import tiny_room

pytestmark = pytest.mark.long

OPTIONS = (
    *("--dataset.max-side", "64", "--dataset.test-every", "4", "--radiance.steps", "20"),
    *("--radiance.sh-degree", "0", "--masks.source", "graph", "--clip.device", "cpu", "--codec.size", "20"),
)


def test_every_item_is_shared_once():
    items = list(range(11))
    shares = [Crew(rank, 3).share(items) for rank in range(3)]
    assert sorted(item for share in shares for item in share) == items
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert [Crew(rank, 3).leads for rank in range(3)] == [True, False, False]


def test_alone_without_a_launcher(monkeypatch):
    monkeypatch.delenv("WORLD_SIZE", raising=False)
    assert join_crew() == Crew(0, 1)
    assert Crew().once(lambda: 7) == 7


def test_a_lost_process_is_said_in_one_line(monkeypatch):
    def lost() -> None:
        raise RuntimeError("Connection closed by peer [127.0.0.1]:55\nmore")

    monkeypatch.setattr("torch.distributed.barrier", lost)
    with pytest.raises(InputError, match=r"ended \(Connection closed by peer .*what is finished is kept"):
        Crew(1, 2).meet()


def test_views_are_read_when_they_are_looked_at():
    pairs = make_views(3)
    views = StoredViews([camera for camera, _ in pairs], [features for _, features in pairs])
    assert len(views) == 3
    assert views[1][1] is pairs[1][1]
    assert [camera for camera, _ in views[1:]] == [camera for camera, _ in pairs[1:]]
    with pytest.raises(ValueError, match="3 cameras, 2 features"):
        StoredViews([camera for camera, _ in pairs], [pairs[0][1]] * 2)


def train(room: Path, out: Path, *launcher: str) -> None:
    command = [sys.executable, "-m", *launcher, "langsplat_core", "train", str(room), "--out", str(out)]
    command += ["--clip.model", str(room / "encoder"), "--phrases", "red mug", *OPTIONS]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Gaussians from 3 photographs") == 1


def test_two_processes_make_the_scene_of_one(tmp_path):
    room = tiny_room(tmp_path / "room")
    train(room, tmp_path / "one.ply")
    together = ("torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")
    train(room, tmp_path / "two.ply", *together)
    for suffix in (".ply", ".langsplat.safetensors"):
        assert (tmp_path / f"two{suffix}").read_bytes() == (tmp_path / f"one{suffix}").read_bytes()
