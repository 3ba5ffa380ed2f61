"""Settings of benchmarks: every number has a range, and what lies outside is refused by name."""

import dataclasses

import pytest

from langsplat_core.config import check_settings, numeric_settings
from langsplat_core.errors import InputError
from langsplat_core.extensions.benchmarks import config

CONFIGS = [
    value
    for value in vars(config).values()
    if isinstance(value, type) and dataclasses.is_dataclass(value) and value.__module__ == config.__name__
]


@pytest.mark.parametrize("settings", CONFIGS)
def test_numbers_outside_their_range_are_refused(settings: type) -> None:
    check_settings(settings())
    for setting in numeric_settings(settings()):
        assert setting.range is not None
        wrong = setting.range.high * 2 + 1
        value = (wrong,) if isinstance(setting.value, tuple) else wrong
        changed = dataclasses.replace(settings(), **{setting.option[2:].replace("-", "_"): value})
        with pytest.raises(InputError, match=f"^{setting.option} "):
            check_settings(changed)
