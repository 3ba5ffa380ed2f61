"""How the options of `langsplat train` come together: a file, profiles, presets, short names."""

from pathlib import Path

import pytest

from langsplat_core.cli.app import parse
from langsplat_core.cli.train import Train
from tests.support.commands import refusal

WORDS = ("train", "photographs", "--out", "s.ply")
PAGE = Path(__file__).parents[2] / "docs" / "photographs.md"


def trained(*words: str, file: Path | None = None, text: str = "") -> Train:
    """What is asked for, with a file that holds `text`."""
    if file is not None:
        file.write_text(text)
        words = (*words, "--config", str(file))
    found = parse([*WORDS, *words])
    assert isinstance(found, Train)
    assert str(found.dataset) == "photographs"
    return found


@pytest.mark.parametrize("name", ["--max-relevancy-error", "--codec.max-relevancy-error"])
def test_every_spelling_of_an_option_takes_its_value_both_ways(name: str) -> None:
    for spelling in (name, name.replace("-", "_").replace("__", "--", 1)):
        assert trained(f"{spelling}=0.002").config.codec.max_relevancy_error == 0.002
        assert trained(spelling, "0.002").config.codec.max_relevancy_error == 0.002


def test_the_example_of_the_docs(tmp_path: Path) -> None:
    (example,) = PAGE.read_text().split("```toml\n")[1:]
    found = trained(file=tmp_path / "train.toml", text=example.partition("```")[0])
    assert found.preset == "good"
    assert found.config.dataset.max_side == 640
    assert found.config.radiance.steps == 3000
    assert found.config.radiance.max_gaussians == 60_000  # the preset's
    assert found.config.clip.model == "demo"
    assert found.config.codec.max_relevancy_error == 0.002
    assert found.config.phrases == ("red mug", "keyboard")


def test_options_beside_a_file_win(tmp_path: Path) -> None:
    file, text = tmp_path / "f.toml", 'preset = "quick"\nradiance.steps = 7\nphrases = ["a", "b"]'
    assert trained(file=file, text=text).config.radiance.steps == 7
    other = trained("--radiance.steps=8", "--preset", "good", "--phrases", "c", file=file, text=text)
    assert (other.preset, other.config.radiance.steps, other.config.phrases) == ("good", 8, ("c",))
    assert other.config.dataset.max_side == 480  # of the preset that was asked for
    assert trained(f"--config={file}").config.dataset.max_side == 320
    flags = "[dataset]\nallow_few_cameras = true"
    assert trained(file=file, text=flags).config.dataset.allow_few_cameras
    assert not trained(
        "--dataset.no-allow-few-cameras", file=file, text=flags
    ).config.dataset.allow_few_cameras


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[radiance]\nstepz = 7", "--radiance.stepz"),
        ("radiance = 5", "--radiance"),
        ("dataset = 'here'", "--dataset"),
        ("help = true", "--help"),
        ("[radiance]\nsteps = 'many'", "--radiance.steps: invalid literal"),
        ("[radiance]\nsteps = 1.5", "--radiance.steps: invalid literal"),
        ("[radiance]\nsteps = true", "--radiance.steps"),
        ("[radiance]\nsteps = 0", "--radiance.steps 0: must be 1 to"),
        ("[[radiance]]\nsteps = 1", "--radiance"),
        ("preset = 'fast'", "invalid choice 'fast'"),
        ("phrases = ['--out', 'x']", "phrases"),
        ("config = 'other.toml'", "config"),
        ("steps = ", "Invalid value"),
        ("\udcff", "utf-8"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_its_key(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "train.toml"
    file.write_text(text, errors="surrogateescape")
    line = refusal(capsys, *WORDS, "--config", file)
    assert line.startswith(f"langsplat: {file}: ")
    assert said in line


@pytest.mark.parametrize(
    "option", ["--radiance.steps", "--codec.max-relevancy-error", "--dataset.test-every"]
)
def test_numbers_in_other_digits_are_refused(option: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"{option}: '١' is not written" in refusal(capsys, *WORDS, option, "١")


@pytest.mark.parametrize("name", ["absent.toml", "."])
def test_a_file_that_cannot_be_read(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert str(tmp_path / name) in refusal(capsys, *WORDS, "--config", tmp_path / name)
