"""The small helpers that every layer shares."""

import numpy as np
import pytest

from langsplat_core.arrays import number, psnr, whole_number


def test_psnr() -> None:
    a = np.zeros((4, 4, 3), np.float32)
    assert psnr(a + np.float32(0.1), a) == pytest.approx(20, abs=1e-5)
    assert psnr(a, a) == 100
    assert psnr(a.astype(np.float16) + 1, a) == pytest.approx(0)


@pytest.mark.parametrize("text", ["١", "1٠", "１", "1_0", "²", "", "x"])
def test_numbers_in_other_digits_are_refused(text: str) -> None:
    for read in (number, whole_number):
        with pytest.raises(ValueError, match=r"digits|convert|literal"):
            read(text)
    assert (number("-1e3"), whole_number(" 7 ")) == (-1000, 7)
