"""Ranges of settings: every number has one, and what lies outside is refused by name, before any work."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest

from langsplat_core import bench, config
from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.config import (
    CodecConfig,
    LiftConfig,
    RadianceConfig,
    Range,
    Setting,
    TrainConfig,
    check_settings,
    numeric_settings,
)
from langsplat_core.errors import InputError
from langsplat_core.pipeline.train import train_scene

CONFIGS = {
    name: value
    for module in (config, bench)
    for name, value in vars(module).items()
    if dataclasses.is_dataclass(value) and isinstance(value, type) and value not in (Range, Setting)
}
SETTINGS = [
    (name, setting)
    for name, cls in sorted(CONFIGS.items())
    for setting in numeric_settings(cls())
    if "." not in setting.option  # those of configurations inside are met in their own class
]
COMMANDS = [
    "train d --out s.ply",
    "query s.ply cup",
    "describe s.ply",
    "select s.ply cup --out t.ply",
    "scale s.ply",
    "convert s.ply t.ply",
    "compact s.ply",
    "bench raster",
    "bench query s.ply",
]


def identify(case: tuple[str, Setting]) -> str:
    return f"{case[0]}{case[1].option}"


def outside(setting: Setting) -> list[Any]:
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


@pytest.mark.parametrize("case", SETTINGS, ids=identify)
def test_every_number_has_a_range_that_holds_its_default(case: tuple[str, Setting]) -> None:
    name, setting = case
    assert setting.range is not None, f"{name}: write Annotated[..., Range(...)] beside {setting.option}"
    assert math.isfinite(setting.range.low)
    assert math.isfinite(setting.range.high)
    check_settings(CONFIGS[name]())


@pytest.mark.parametrize("case", SETTINGS, ids=identify)
def test_every_number_outside_its_range_is_refused_by_name(case: tuple[str, Setting]) -> None:
    name, setting = case
    field = setting.option.removeprefix("--").replace("-", "_")
    for value in outside(setting):
        wrong = dataclasses.replace(CONFIGS[name](), **{field: value})
        with pytest.raises(InputError) as caught:
            check_settings(wrong)
        message = str(caught.value)
        assert message.startswith(f"{setting.option} "), message
        assert "\n" not in message
        assert len(message) < 200


@pytest.mark.parametrize("line", COMMANDS)
def test_every_number_of_every_command_has_a_range(line: str) -> None:
    command = parse(line.split())
    assert [setting.option for setting in numeric_settings(command) if setting.range is None] == []
    check_settings(command)


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("train {d} --out {d}/s.ply --radiance.sh-degree 4", "--radiance.sh-degree 4: must be 0 to 3"),
        ("train {d} --out {d}/s.ply --radiance.sh-degree -1", "--radiance.sh-degree -1"),
        ("train {d} --out {d}/s.ply --radiance.steps 0", "--radiance.steps 0"),
        ("train {d} --out {d}/s.ply --radiance.max-gaussians -1", "--radiance.max-gaussians -1"),
        ("train {d} --out {d}/s.ply --radiance.reference-steps 0", "--radiance.reference-steps 0"),
        ("train {d} --out {d}/s.ply --radiance.checkpoint-every 0", "--radiance.checkpoint-every 0"),
        (
            "train {d} --out {d}/s.ply --radiance.position-lr-init 0",
            "--radiance.position-lr-init 0: must be above 0 and at most 10",
        ),
        ("train {d} --out {d}/s.ply --radiance.seed -1", "--radiance.seed -1"),
        ("train {d} --out {d}/s.ply --codec.seed 99999999999999999999999", "--codec.seed 9999"),
        ("train {d} --out {d}/s.ply --codec.latent-dim 0", "--codec.latent-dim 0: must be 1 to 4096"),
        ("train {d} --out {d}/s.ply --codec.latent-dim -1", "--codec.latent-dim -1"),
        ("train {d} --out {d}/s.ply --codec.batch 1", "--codec.batch 1"),
        ("train {d} --out {d}/s.ply --codec.lr nan", "--codec.lr nan"),
        ("train {d} --out {d}/s.ply --lift.chunk 0", "--lift.chunk 0"),
        ("train {d} --out {d}/s.ply --lift.chunk -1", "--lift.chunk -1"),
        ("train {d} --out {d}/s.ply --dataset.max-side 3", "--dataset.max-side 3"),
        ("convert a.npz b.ply --codec.steps 0", "--codec.steps 0"),
        ("bench raster --sizes 320 240 0 7", "--sizes 320 240 0 7"),
    ],
)
def test_the_command_line_names_the_option_as_typed(
    line: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = line.format(d=tmp_path).split()
    assert main("langsplat", lambda: parse(words)) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"langsplat: {named}")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []  # nothing was begun


@pytest.mark.parametrize(
    "wrong",
    [
        TrainConfig(radiance=RadianceConfig(steps=0)),
        TrainConfig(codec=CodecConfig(batch=1)),
        TrainConfig(lift=LiftConfig(chunk=0)),
    ],
)
def test_python_is_refused_alike(wrong: TrainConfig, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"^--(radiance\.steps|codec\.batch|lift\.chunk) "):
        train_scene(tmp_path / "absent", tmp_path / "s.ply", wrong)
    assert list(tmp_path.iterdir()) == []


@dataclasses.dataclass(frozen=True)
class Sample:
    plain: int = 3
    length: Annotated[float, Range(0.0, 1.0, above=True)] | None = None
    pair: tuple[Annotated[int, Range(1, 9)], Annotated[int, Range(1, 9)]] = (1, 9)
    text: str = "no number"
    switch: bool = False


def test_a_field_without_a_range_is_seen():
    found = {setting.option: setting.range for setting in numeric_settings(Sample())}
    assert found["--plain"] is None
    assert list(found) == ["--plain", "--length", "--pair"]


def test_values_inside_pass_whatever_their_kind():
    check_settings(Sample(length=None, pair=(1, 9)))
    check_settings(Sample(length=np.float32(1), pair=(np.int64(1), 9)))  # type: ignore[arg-type]
    check_settings(Sample(length=1))
    with pytest.raises(InputError, match="above 0 and at most 1"):
        check_settings(Sample(length=0.0))
    with pytest.raises(InputError, match="whole number"):
        check_settings(Sample(pair=(True, 1)))
