"""Every input format, among them every row of the table of scene formats, against thousands of damaged files:
read, or refused in one line, and nothing else."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.io.scenes import FORMATS
from tests.support.file_kinds import KINDS, FileKind
from tests.support.mutation import FuzzRun, Outcome

SEEDS = (1, 2)
# In which a byte that is missing cannot go unseen, nor can another format's file be taken for one.
STRICT = [
    "INRIA PLY",
    "compressed PLY",
    "SOG",
    "SPZ 3",
    "SPZ 4",
    ".splat",
    ".ksplat",
    "sidecar",
    "cameras.json",
]
MUTANTS = 3000  # of a kind and seed


def mutants(kind: FileKind, samples: list[bytes], count: int, seed: int) -> Iterator[bytes]:
    rng = np.random.default_rng(seed)
    for number in range(count):
        yield kind.damage(samples[number % len(samples)], samples, rng)


def fuzz(name: str, folder: Path, count: int, seed: int) -> Outcome:
    """What became of `count` mutants, after the good samples were read without a word."""
    kind = KINDS[name]
    samples = kind.samples(folder)
    good = FuzzRun(folder / kind.file, kind.read).run(iter(samples))
    assert (good.loaded, good.warned) == (len(samples), 0), good.summary()
    return FuzzRun(folder / kind.file, kind.read).run(mutants(kind, samples, count, seed))


def check(outcome: Outcome) -> None:
    assert not outcome.faults, outcome.summary()
    assert outcome.refused + outcome.loaded == outcome.tried
    assert outcome.refused + outcome.warned > outcome.tried / 50  # the mutations do hurt


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_mutants(tmp_path: Path, name: str, request: pytest.FixtureRequest) -> None:
    seed = request.config.getoption("--seed")
    for used in SEEDS if seed is None else (seed,):
        folder = tmp_path / str(used)
        folder.mkdir()
        outcome = fuzz(name, folder, MUTANTS, used)
        print(f"{name}, seed {used}: {outcome.summary()}")
        check(outcome)


@pytest.mark.long
@pytest.mark.parametrize("name", KINDS)
def test_a_few_mutants(tmp_path: Path, name: str) -> None:
    check(fuzz(name, tmp_path, 60, seed=0))


def test_every_scene_format_is_among_the_kinds():
    assert {row.suffix for row in FORMATS} <= {Path(kind.file).suffix for kind in KINDS.values()}


def refused(name: str, folder: Path, contents: list[bytes]) -> int:
    outcome = FuzzRun(folder / KINDS[name].file, KINDS[name].read).run(iter(contents))
    assert not outcome.faults, outcome.summary()
    return outcome.refused


@pytest.mark.long
@pytest.mark.parametrize("name", STRICT)
def test_truncated_at_many_places(tmp_path: Path, name: str) -> None:
    sample = KINDS[name].samples(tmp_path)[0]
    size = len(sample) - (name == "cameras.json")  # the line feed behind JSON means nothing
    places = sorted({*range(0, size, max(1, size // 150)), *range(size - 12, size)})
    if name == ".splat":  # nothing in it tells how many Gaussians follow
        places = [place for place in places if place % 32 or place == 0]
    assert refused(name, tmp_path, [sample[:place] for place in places]) == len(places)


@pytest.mark.long
@pytest.mark.parametrize("name", STRICT)
def test_random_bytes_and_other_formats_are_refused(tmp_path: Path, name: str) -> None:
    rng, kind = np.random.default_rng(2), KINDS[name]
    magic = kind.samples(tmp_path)[0][:8]
    noise = [magic[: 8 * (number % 2)] + rng.bytes(int(rng.integers(1, 3000)) | 1) for number in range(60)]
    others = [KINDS[other] for other in STRICT if KINDS[other].file != kind.file]
    noise += [other.samples(tmp_path)[0] for other in others]
    assert refused(name, tmp_path, noise) == len(noise)
