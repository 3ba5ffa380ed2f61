"""Trainings that are killed in every stage end as if nothing had been; `-s` shows the table."""

import os
import signal
from pathlib import Path

import pytest

from langsplat_core.datasets.intrinsics import PhotoIntrinsics
from tests.support.kills import SCENE, moments, train
from tests.support.photographed import colmap_reconstruction, poses, write_photos
from tests.support.tiny_clip import tiny_clip

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="no signal 9")]
LENS = PhotoIntrinsics(320, 240, 300.0, 300.0, 160.0, 120.0)
VIEWS = 6


def photographs(folder: Path, kind: str) -> Path:
    """Of the room, plain or with the cameras of a COLMAP model without points."""
    names = write_photos(folder / "images", LENS, poses(VIEWS))
    if kind == "COLMAP":
        (folder / "sparse" / "0").mkdir(parents=True)
        params = [LENS.fx, LENS.fy, LENS.cx, LENS.cy]
        size = (LENS.width, LENS.height)
        model = colmap_reconstruction("PINHOLE", size, params, names, poses(VIEWS))
        model.write_binary(folder / "sparse" / "0")
    return folder


@pytest.mark.parametrize("kind", ["photographs", "COLMAP"])
def test_killed_in_every_stage_it_ends_with_the_same_bytes(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """One run, killed once in each stage at a random moment and begun again, against one that was not."""
    data, encoder = photographs(tmp_path / "data", kind), tmp_path / "encoder"
    tiny_clip(encoder)
    whole = train(data, encoder, tmp_path / "whole")
    assert whole.code == 0, whole.said
    seed = request.config.getoption("--seed") or 0
    killed = []
    for moment in moments(whole, seed):
        ended = train(data, encoder, tmp_path / "killed", moment)
        assert ended.code in (0, -signal.SIGKILL), ended.said  # 0: it was faster than before
        killed.append(ended.code != 0)
        when = f"{100 * moment.fraction:.0f} %" if moment.fraction else f"{moment.seconds:.1f} s"
        print(
            f"| {kind} | {moment.stage} | {when} | {'killed' if killed[-1] else 'ended before'} |", flush=True
        )
    assert sum(killed) > len(killed) / 2
    last = train(data, encoder, tmp_path / "killed")
    assert last.code == 0, last.said
    same = {
        name: (tmp_path / "killed" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
        for name in SCENE
    }
    print(f"| {kind} | {sum(killed)} kills | same bytes: {same} |")
    assert all(same.values())
    left = [path.name for path in (tmp_path / "killed").rglob("*") if path.name.startswith(".")]
    print(f"| {kind} | temporary files left: {left} |")
