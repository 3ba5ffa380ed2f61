"""Every input format against thousands of damaged files: read, or refused in one line, and nothing else."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.support.mutant_kinds import KINDS, MutantKind
from tests.support.ordeal import Ordeal, Outcome

SEEDS = (1, 2)
MUTANTS = 3000  # of a kind and seed


def mutants(kind: MutantKind, samples: list[bytes], count: int, seed: int) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    for number in range(count):
        yield kind.damage(samples[number % len(samples)], samples, rng)


def ordeal(name: str, folder: Path, count: int, seed: int) -> Outcome:
    kind = KINDS[name]
    samples = kind.samples(folder)
    trial = Ordeal(folder / kind.file, kind.read)
    assert trial.run(iter(samples)).loaded == len(samples), trial.outcome.summary()
    return Ordeal(folder / kind.file, kind.read).run(mutants(kind, samples, count, seed))


def check(outcome: Outcome) -> None:
    print(outcome.summary())
    assert not outcome.faults, outcome.summary()
    assert outcome.refused + outcome.loaded == outcome.tried
    assert outcome.refused + outcome.warned > outcome.tried / 50  # the wounds do hurt


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_mutants(tmp_path: Path, name: str, request: pytest.FixtureRequest) -> None:
    for seed in [request.config.getoption("--seed")] if request.config.getoption("--seed") else SEEDS:
        check(ordeal(name, tmp_path / str(seed), MUTANTS, seed))
