"""The real window while the camera moves: coarse pictures of merged Gaussians, then the full one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.long
def test_pictures_are_coarse_while_moving_and_sharp_afterwards(display: str, tmp_path: Path):
    environment = {key: value for key, value in os.environ.items() if key != "WAYLAND_DISPLAY"}
    paths = os.pathsep.join((str(ROOT), str(ROOT / "app")))
    script = (
        "import sys, langsplat_viewer.drawing.pacing as pacing\n"
        "pacing.MOVING_BUDGET = 0.0\n"  # however fast the machine is
        "from pathlib import Path\n"
        "from dataclasses import asdict\n"
        "import json\n"
        "from tests.viewer.orbit_driver import DEMO, ride\n"
        "print(json.dumps(asdict(ride(DEMO, 0, 2.0, (860, 620)))))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script],
        env=environment | {"DISPLAY": display, "PYTHONPATH": paths},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert run.returncode == 0, (run.stdout + run.stderr)[-3000:]
    seen = json.loads(run.stdout)
    assert len(seen["sharp_after"]) == 3
    assert all(rate > 0 for rate in seen["pictures_per_second"])
    if seen["backend"] == "cpu":
        assert all(width < 250 for width, _ in seen["sizes"])  # a quarter of what the panels leave
        assert seen["merged"] == [True] * 3
