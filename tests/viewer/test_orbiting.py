"""The real window while the camera moves: coarse pictures of merged Gaussians, then the full one."""

import json
from pathlib import Path

import pytest

from tests.support.on_display import play


@pytest.mark.long
def test_pictures_are_coarse_while_moving_and_sharp_afterwards(display: str, tmp_path: Path):
    script = (
        "import sys, langsplat_viewer.canvas as pacing\n"
        "pacing.MOVING_BUDGET = 0.0\n"  # however fast the machine is
        "from pathlib import Path\n"
        "from dataclasses import asdict\n"
        "import json\n"
        "from tests.viewer.orbit_driver import DEMO, ride\n"
        "print(json.dumps(asdict(ride(DEMO, 0, 2.0, (860, 620)))))\n"
    )
    seen = json.loads(play(display, ["-c", script], tmp_path, timeout=200))
    assert len(seen["sharp_after"]) == 3
    assert all(rate > 0 for rate in seen["pictures_per_second"])
    if seen["backend"] == "cpu":
        assert all(width < 250 for width, _ in seen["sizes"])  # a quarter of what the panels leave
        assert seen["merged"] == [True] * 3
