"""`langsplat bench moving`: that it measures what it says. No time is asserted."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from langsplat_core.cli.bench_moving import BenchMoving
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.config import MovingBenchConfig
from langsplat_core.lab.speed.moving import WAYS, measure_moving

DEMO = Path(__file__).parents[3] / "assets" / "demo" / "scene.ply"
SMALL = MovingBenchConfig(count=0, size=(160, 100), views=2)


@pytest.mark.long
def test_every_way_is_measured_and_coarser_is_farther_off(tmp_path, capsys):
    BenchMoving(DEMO, SMALL, tmp_path).run()
    report = json.loads((tmp_path / "moving.json").read_text())["report"]
    costs = report["costs"]
    assert tuple((cost["scale"], cost["merged"]) for cost in costs) == WAYS
    full, half, quarter, half_merged, quarter_merged = costs
    assert (full["psnr"], full["error"]) == (100, 0)
    assert 100 > half["psnr"] > quarter["psnr"] > 10
    assert half_merged["psnr"] > quarter_merged["psnr"] > 10
    assert full["gaussians"] == half["gaussians"] > 2 * half_merged["gaussians"]
    assert all(cost["milliseconds"] > 0 and cost["processor"] > 0 for cost in costs)
    assert (tmp_path / "moving.md").read_text() in capsys.readouterr().out


def test_a_scene_without_cameras_is_refused():
    scene = replace(load_scene(DEMO), cameras=())
    with pytest.raises(InputError, match="training cameras"):
        measure_moving(scene, SMALL)
