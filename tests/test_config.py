"""Settings: every number has a range, and what lies outside is refused by name, before any work; options of
`langsplat train` come together from profiles, presets and short names."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from langsplat_core import config
from langsplat_core.cli.app import parse
from langsplat_core.cli.train import Train
from langsplat_core.config import AutoencoderConfig, TrainConfig, check_settings, numeric_settings
from langsplat_core.errors import InputError
from langsplat_core.pipeline.train import train_scene
from tests.support.processes import refusal

CONFIGS = {
    name: value
    for name, value in vars(config).items()
    if dataclasses.is_dataclass(value)
    and isinstance(value, type)
    and value not in (config.Range, config.Setting)
}
SETTINGS = [
    (name, setting)
    for name, cls in sorted(CONFIGS.items())
    for setting in numeric_settings(cls())
    if "." not in setting.option  # those of configurations inside are met in their own class
]
COMMANDS = (
    "train d --out s.ply",
    "train d --out s.ply --codec.kind linear",
    "query s.ply cup",
    "describe s.ply",
    "select s.ply cup --out t.ply",
    "scale s.ply",
    "convert s.ply t.ply",
    "convert s.npz t.ply --codec.kind=autoencoder",
    "compact s.ply",
    "bench raster",
    "bench query s.ply",
)


def outside(setting: config.Setting) -> list[Any]:
    """Values that its range excludes, in the shape of the setting's own value."""
    bound = setting.range
    assert bound is not None
    below = bound.low if bound.above else bound.low - 1
    values: list[Any] = [below, bound.high * 2 + 1, 10**400, math.nan, math.inf, -math.inf, "7"]
    if setting.whole:
        values.append(bound.low + 0.5)
    found: list[Any] = [shaped(setting.value, value) for value in values]
    return found + ([()] if bound.some else [])


def shaped(like: Any, value: Any) -> Any:
    """`value` in the last place of a tuple such as `like`, or as it is."""
    return (*like[:-1], shaped(like[-1], value)) if isinstance(like, tuple) and like else value


@pytest.mark.parametrize(("name", "setting"), SETTINGS, ids=lambda part: getattr(part, "option", part))
def test_numbers_outside_their_range_are_refused_by_name(name: str, setting: config.Setting) -> None:
    assert setting.range is not None, f"{name}: write Annotated[..., Range(...)] beside {setting.option}"
    assert np.isfinite([setting.range.low, setting.range.high]).all()
    check_settings(CONFIGS[name]())
    field = setting.option.removeprefix("--").replace("-", "_")
    for value in outside(setting):
        wrong = dataclasses.replace(CONFIGS[name](), **{field: value})
        with pytest.raises(InputError) as caught:
            check_settings(wrong)
        message = str(caught.value)
        assert message.startswith(f"{setting.option} "), message
        assert len(message) < 200


@pytest.mark.parametrize("line", COMMANDS)
def test_every_number_of_every_command_has_a_range(line: str) -> None:
    command = parse(line.split())
    assert [setting.option for setting in numeric_settings(command) if setting.range is None] == []
    check_settings(command)


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("--radiance.sh-degree 4", "--radiance.sh-degree 4: must be 0 to 3"),
        ("--codec.kind linear --codec.latent-dim 0", "--codec.latent-dim 0: must be 1 to 4096"),
        ("--profile paper --codec.lr nan", "--codec.lr nan"),
        ("--codec.kind vq", "--codec.kind vq: choose one of codebook, autoencoder, linear"),
        ("--codec.steps 7", "unrecognized options: --codec.steps"),  # a codebook has none
        ("--codec.kind linear --max-relevancy-error 0.1", "unrecognized options: --max-relevancy-error"),
    ],
)
def test_the_command_line_names_the_option_as_typed(
    line: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    error = refusal(capsys, "train", tmp_path, "--out", tmp_path / "s.ply", *line.split())
    assert error.lower().startswith(f"langsplat: {named}")
    assert list(tmp_path.iterdir()) == []  # nothing was begun


def test_python_callers_are_refused_alike(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--codec\.batch "):
        train_scene(tmp_path / "absent", tmp_path / "s.ply", TrainConfig(codec=AutoencoderConfig(batch=1)))
    assert list(tmp_path.iterdir()) == []


# How the options of `langsplat train` come together.

WORDS = ("train", "photographs", "--out", "s.ply")


def trained(*words: str) -> Train:
    found = parse([*WORDS, *words])
    assert isinstance(found, Train)
    assert str(found.dataset) == "photographs"
    return found


@pytest.mark.parametrize("name", ["--max-relevancy-error", "--codec.max-relevancy-error"])
def test_every_spelling_of_an_option_takes_its_value_both_ways(name: str) -> None:
    for spelling in (name, name.replace("-", "_").replace("__", "--", 1)):
        assert trained(f"{spelling}=0.002").config.codec.max_relevancy_error == 0.002
        assert trained(spelling, "0.002").config.codec.max_relevancy_error == 0.002


def test_options_beside_a_preset_win() -> None:
    found = trained("--radiance.steps=8", "--preset", "good", "--phrases", "red mug", "keyboard")
    assert (found.preset, found.config.radiance.steps) == ("good", 8)
    assert (found.config.dataset.max_side, found.config.radiance.max_gaussians) == (480, 60_000)
    assert found.config.phrases == ("red mug", "keyboard")
