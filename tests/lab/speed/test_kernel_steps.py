"""Every step that the benchmark takes out is still in the kernels, and the table says what was measured."""

import shutil
from pathlib import Path

import pytest

from langsplat_core.errors import BackendError
from langsplat_core.lab.speed.kernel_steps import PACKAGE, VARIANTS, StepTimes, Variant, steps_table, take_out


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_a_step_can_be_taken_out(variant: Variant, tmp_path: Path) -> None:
    sources = shutil.copytree(PACKAGE / "raster" / "cpu", tmp_path / "cpu")
    take_out(variant, sources)
    for name, _, new in variant.edits:
        assert new in (sources / name).read_text()


def test_a_step_that_is_gone_is_said(tmp_path: Path) -> None:
    (tmp_path / "walk.py").write_text("nothing\n")
    with pytest.raises(BackendError, match="no longer holds"):
        take_out(Variant("early stop", (("walk.py", "CHECK_EVERY = 16", ""),)), tmp_path)


def test_the_table_compares_with_the_whole() -> None:
    rows = [StepTimes("whole", {"splat": 2.0}, 0.0), StepTimes("no prefetching", {"splat": 5.0}, 1e-6)]
    assert "| no prefetching | 5.0 (2.50x) | 1.0e-06 |" in steps_table(rows)
