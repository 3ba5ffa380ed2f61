"""Every script in `docs/examples` runs without arguments of its own, and says and draws what it promises."""

import re
import runpy
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytestmark = pytest.mark.long

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


def run(name: str, out: Path) -> str:
    """What the example prints; its files are written to `out`."""
    path = str(EXAMPLES / f"{name}.py")
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as said:
        patch.setattr("sys.argv", [path, str(out)])
        runpy.run_path(path, run_name="__main__")
    return said.getvalue()


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path)).astype(int)


def test_render_a_picture(tmp_path: Path) -> None:
    shares = re.findall(r"(\d+)% covered", run("01_render_a_picture", tmp_path))
    assert len(shares) == 2
    for share, name in zip(shares, ("photograph.png", "own_place.png"), strict=True):
        assert int(share) > 90
        picture = pixels(tmp_path / name)
        assert picture.shape == (240, 320, 3)
        assert picture.std() > 30


def test_ask_a_phrase(tmp_path: Path) -> None:
    there, place, absent = run("02_ask_a_phrase", tmp_path).splitlines()
    assert there.startswith("blue gift: found, score 0.")
    assert len(re.findall(r"-?\d+\.\d+", place)) == 3
    assert absent.startswith("yellow banana: not here")
    heat = pixels(tmp_path / "relevancy.png")
    assert heat.shape == (240, 320)
    assert 0.005 < (heat > 200).mean() < 0.1  # the gift is a small part of the picture
    assert (heat < 150).mean() > 0.9


def test_lift_your_own_features(tmp_path: Path) -> None:
    observed, agree = map(
        int, re.findall(r"(\d+)(?: Gaussians|%)", run("03_lift_your_own_features", tmp_path))
    )
    assert observed > 50_000
    assert agree > 90
    assert pixels(tmp_path / "lifted.png").shape == (180, 240, 3)


def test_write_a_backend(tmp_path: Path) -> None:
    errors = re.findall(r"(\w+): mean error (\S+), largest (\S+)", run("04_write_a_backend", tmp_path))
    (discs, coarse, _), (cpu, fine, largest) = errors
    assert (discs, cpu) == ("discs", "cpu")
    assert 1e-3 < float(coarse) < 0.2
    assert float(fine) < 1e-6
    assert float(largest) < 1e-4
