"""Every input format against thousands of damaged files: read, or refused in one line, and nothing else."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import FormatError
from tests.support.mutant_kinds import KINDS, MutantKind
from tests.support.ordeal import Ordeal, Outcome

SEEDS = (1, 2)
MUTANTS = 3000  # of a kind and seed


def mutants(kind: MutantKind, samples: list[bytes], count: int, seed: int) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    for number in range(count):
        yield kind.damage(samples[number % len(samples)], samples, rng)


def ordeal(name: str, folder: Path, count: int, seed: int) -> Outcome:
    """What became of `count` mutants, after the good samples were read without a word."""
    kind = KINDS[name]
    samples = kind.samples(folder)
    good = Ordeal(folder / kind.file, kind.read).run(iter(samples))
    assert (good.loaded, good.warned) == (len(samples), 0), good.summary()
    return Ordeal(folder / kind.file, kind.read).run(mutants(kind, samples, count, seed))


def check(outcome: Outcome) -> None:
    assert not outcome.faults, outcome.summary()
    assert outcome.refused + outcome.loaded == outcome.tried
    assert outcome.refused + outcome.warned > outcome.tried / 50  # the wounds do hurt


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_mutants(tmp_path: Path, name: str, request: pytest.FixtureRequest) -> None:
    seed = request.config.getoption("--seed")
    for used in SEEDS if seed is None else (seed,):
        folder = tmp_path / str(used)
        folder.mkdir()
        outcome = ordeal(name, folder, MUTANTS, used)
        print(f"{name}, seed {used}: {outcome.summary()}")
        check(outcome)


@pytest.mark.long
@pytest.mark.parametrize("name", KINDS)
def test_a_few_mutants(tmp_path: Path, name: str) -> None:
    check(ordeal(name, tmp_path, 60, seed=0))


def test_the_damage_is_reproducible(tmp_path: Path) -> None:
    kind = KINDS[".splat"]
    samples = kind.samples(tmp_path)
    first, second = (list(mutants(kind, samples, 20, seed=5)) for _ in range(2))
    assert first == second
    assert len(set(first)) == 20


@pytest.mark.parametrize(
    ("read", "fault"),
    [
        (lambda _: 1 / 0, "ZeroDivisionError"),
        (lambda _: 0.4, "mostly unsound, unsaid"),
        (lambda _: refuse("two\nlines " + "x" * 400), "message: "),
        (lambda _: np.float32(3e38) * np.float32(2), "RuntimeWarning"),
        (lambda _: len(b"x" * 320_000_000) and 1.0, "memory: "),
        (lambda _: os.write(2, b"stray") and 1.0, "on the standard error: 'stray'"),
    ],
)
def test_the_ordeal_itself_can_fail(tmp_path: Path, read: Callable[[Path], float], fault: str) -> None:
    outcome = Ordeal(tmp_path / "a", read).run(iter([b"content"]))
    assert [what.startswith(fault) for what in outcome.faults] == [True], outcome.summary()


def refuse(message: str) -> float:
    raise FormatError(message)
