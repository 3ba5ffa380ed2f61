"""Ranges of settings: written beside the field that they bound, checked in one place before anything runs.

    steps: Annotated[int, Range(1, 1_000_000)] = 100

`check_settings` walks a configuration with all configurations in it. A field may also hold several numbers,
as pairs and lists do; every one of them must then lie in the range.
"""

import dataclasses
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Annotated, Any, get_args, get_origin

from langsplat_core.errors import InputError


@dataclass(frozen=True)
class Range:
    """Where a number must lie; both ends count, but for `low` where `above` says so. Always finite."""

    low: float
    high: float
    above: bool = False  # low itself is no value
    some: bool = False  # of a field with several numbers: there must be at least one

    def holds(self, value: float) -> bool:
        """Whether `value` lies in the range; NaN lies in none."""
        return (self.low < value if self.above else self.low <= value) and value <= self.high

    def __str__(self) -> str:
        low, high = _word(self.low), _word(self.high)
        return f"above {low} and at most {high}" if self.above else f"{low} to {high}"


@dataclass(frozen=True)
class Setting:
    """A field with numbers in it, of a configuration or of one that it holds."""

    option: str  # as typed on the command line
    value: Any
    range: Range | None
    whole: bool  # whole numbers only


def check_settings(settings: object, option: str = "--") -> None:
    """InputError for the first number in `settings`, a dataclass, that is outside the range of its field.

    `option` is what precedes the fields' names on the command line, such as ``--codec.``.
    """
    for setting in numeric_settings(settings, option):
        problem = _problem(setting)
        if problem:
            raise InputError(f"{setting.option} {_shown(setting.value)}: {problem}")


def numeric_settings(settings: object, option: str = "--") -> Iterator[Setting]:
    """All fields of a dataclass that hold numbers, and those of dataclasses in it, in their order."""
    for name, value, hint in named_values(settings, option):
        kinds = set(_kinds(hint))
        if kinds & {int, float}:
            bound = next((part for part in annotations(hint) if isinstance(part, Range)), None)
            yield Setting(name, value, bound, whole=float not in kinds)


def named_values(settings: object, option: str = "--") -> Iterator[tuple[str, Any, Any]]:
    """(option as typed, value, type hint) of every field of a dataclass and of dataclasses in it."""
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]  # checked by the callers' types
        value, hint = getattr(settings, field.name), hints[field.name]
        name = option + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            yield from named_values(value, option if _is_flat(hint) else f"{name}.")
        else:
            yield name, value, hint


def annotations(hint: Any) -> Iterator[Any]:
    """What `Annotated` says beside the type, also inside of unions, tuples and further `Annotated`."""
    if get_origin(hint) is Annotated:
        yield from hint.__metadata__
    if get_origin(hint) is not typing.Literal:
        for part in get_args(hint):
            yield from annotations(part)


def _kinds(hint: Any) -> Iterator[type]:
    """The plain types in a type hint: int and float of ``tuple[int, ...] | float``."""
    if get_origin(hint) is typing.Literal:
        return
    if get_origin(hint) is Annotated:
        yield from _kinds(hint.__origin__)
    elif get_args(hint):
        for part in get_args(hint):
            yield from _kinds(part)
    elif isinstance(hint, type) and hint is not types.NoneType:
        yield hint


def _is_flat(hint: Any) -> bool:
    """Whether a dataclass's fields are options without its own name: ``tyro.conf.arg(name="")``."""
    return any(getattr(part, "name", None) == "" for part in annotations(hint))


def _problem(setting: Setting) -> str | None:
    """What is wrong with a setting's value; None where nothing is."""
    bound, numbers = setting.range, list(_flat(setting.value))
    if bound is None:
        return None
    if bound.some and not numbers:
        return "give at least one number"
    for number in numbers:
        kind: Any = Integral if setting.whole else Real
        if isinstance(number, bool) or not isinstance(number, kind):
            return f"must be {'a whole number' if setting.whole else 'a number'}, {bound}"
        if not bound.holds(number):
            return f"must be {bound}"
    return None


def _flat(value: Any) -> Iterator[Any]:
    """The values in tuples and lists of them; an absent one and a word in place of a number are none."""
    if isinstance(value, tuple | list):
        for part in value:
            yield from _flat(part)
    elif value is not None:
        yield value


def _shown(value: Any) -> str:
    """As it would be typed, and short."""
    text = " ".join(map(_word, _flat(value)))
    return text if len(text) <= 40 else f"{text[:36]} ..."


def _word(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    try:
        return str(value)
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a number of thousands of digits"
