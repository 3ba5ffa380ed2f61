"""The small helpers that every layer shares."""

import numpy as np
import pytest

from langsplat_core.arrays import psnr


def test_psnr() -> None:
    a = np.zeros((4, 4, 3), np.float32)
    assert psnr(a + np.float32(0.1), a) == pytest.approx(20, abs=1e-5)
    assert psnr(a, a) == 100
    assert psnr(a.astype(np.float16) + 1, a) == pytest.approx(0)
