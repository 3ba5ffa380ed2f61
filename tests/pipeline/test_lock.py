"""A work folder belongs to one training at a time, and to none once that has ended, however it ended."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from langsplat_core.errors import InputError
from langsplat_core.pipeline.stages import LOCK, sole_use

pytestmark = pytest.mark.long

HOLD = (
    "import sys, time\nfrom pathlib import Path\nfrom langsplat_core.pipeline.stages import sole_use\n"
    "with sole_use(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)\n"
)


def test_a_second_one_is_told_who_is_there_and_a_dead_one_holds_nothing(tmp_path: Path) -> None:
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


def test_one_after_the_other_and_never_two_in_one_process(tmp_path: Path) -> None:
    work = tmp_path / "c"
    for _ in range(2):
        with sole_use(work), pytest.raises(InputError, match="--work"), sole_use(work):
            pass
    with sole_use(tmp_path / "a"), sole_use(tmp_path / "b"):
        (tmp_path / "a" / "result").touch()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["a", LOCK, "result"]  # b held nothing
