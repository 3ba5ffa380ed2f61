"""Workspaces of structure from motion: folders that processes of their own fill, and later runs take up.

A workspace, named by a digest of its inputs, holds small copies of the photographs (``images``), COLMAP's
``database.db`` and, in the end, the model (``sparse``) and the graph of matches (``matches.json``).
"""

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from langsplat_core.datasets.photos import ExifFacts, exif_facts
from langsplat_core.errors import FormatError, printable_line, shortened
from langsplat_core.io import apart
from langsplat_core.progress import Progress

MASKS = "masks"  # in the workspace: black where no features are wanted
MATCHES = "matches.json"  # features and pairs
DIGEST = "digest"  # in a finished model's folder: of its files, and of the matches
FAILURES = (RuntimeError, ValueError, IndexError)  # what pycolmap raises
ROOM = 64_000_000  # bytes that a step may want: 8 photographs of 8192 features take 20 MB, with the journal
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # sums of several differ from run to run

Pair = tuple[str, str]


@dataclass(frozen=True)
class CameraGroup:
    """Photographs of one size that share one camera."""

    names: tuple[str, ...]  # file names in the workspace's images folder
    model: str  # COLMAP's camera model
    params: str = ""  # its parameters, comma-separated; empty: guessed from EXIF data or the size
    doubled: bool = False  # doubled in size before features are sought, as SIFT proposes


def open_workspace(work: Path, inputs: object) -> Path:
    """Return ``work/sfm-<digest>`` of `inputs`, anything that JSON can hold."""
    digest = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:12]
    folder = work / f"sfm-{digest}"
    if not (folder / "sparse").is_dir():
        (folder / "images").mkdir(parents=True, exist_ok=True)
    return folder


def run_apart(function: Callable[..., Any], *arguments: Any, workspace: Path, progress: Progress) -> Any:
    """Return ``function(*arguments, progress)``, run in a process of its own, which pycolmap may end.

    Raises RuntimeError if pycolmap ends it, and OSError for any failure while the disk is nearly full.
    """
    try:
        return apart.run(function, *arguments, progress=progress, environment=ONE_THREAD)
    except (apart.AbortedError, *FAILURES) as error:
        if shutil.disk_usage(workspace).free < ROOM:
            raise disk_full(workspace) from None
        raise error if isinstance(error, FAILURES) else RuntimeError(f"it {error}") from None


def digest_of_model(folder: Path) -> str:
    """Return a digest of the files of a workspace's model, and of its graph of matches."""
    paths = [path for path in (*sorted(folder.iterdir()), folder.with_name(MATCHES)) if path.name != DIGEST]
    digest = hashlib.sha256()
    for path in filter(Path.is_file, paths):
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)} ".encode() + content)
    return digest.hexdigest()


def disk_full(folder: Path) -> OSError:
    """Return the error of a disk without room."""
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


# The graph of the photographs that share verified matches: groups, and the gaps between them.

FEWEST_MATCHES = 15  # that COLMAP's mapper works with
FEWEST_FEATURES = 50  # fewer rarely give `FEWEST_MATCHES`
SHARING = "each sharing at least two thirds of its view with the next"  # what matches well
UNREADABLE = "cannot be read"  # why a photograph has no camera


@dataclass(frozen=True)
class Matches:
    """The graph of matches of all photographs of a dataset, located or not, in name order."""

    names: tuple[str, ...]  # file names
    features: tuple[int, ...]  # of each; -1 where the file could not be read
    pairs: tuple[tuple[int, int, int], ...]  # rows of two photographs, and their verified matches
    located: frozenset[int]  # rows of those that have a camera
    exif: tuple[ExifFacts, ...] = ()  # how each was taken; (): unknown

    @cached_property
    def shared(self) -> dict[tuple[int, int], int]:
        """Number of verified matches of each pair of rows, the smaller row first."""
        return {(min(a, b), max(a, b)): count for a, b, count in self.pairs}

    @cached_property
    def groups(self) -> list[list[int]]:
        """Groups of rows: the located ones, then the connected components of the others, largest first."""
        count = len(self.names)
        joins = [(a, b) for a, b, n in self.pairs if n >= FEWEST_MATCHES and not self.located & {a, b}]
        rows, columns = np.array(joins, int).reshape(-1, 2).T
        graph = scipy.sparse.coo_array((np.ones(len(rows), bool), (rows, columns)), (count, count))
        _, labels = scipy.sparse.csgraph.connected_components(graph, directed=False)
        found: dict[int, list[int]] = {}
        for row in range(count):
            if row not in self.located:
                found.setdefault(int(labels[row]), []).append(row)
        others = sorted(found.values(), key=len, reverse=True)
        return [sorted(self.located), *others] if self.located else others

    @cached_property
    def captures(self) -> list[list[int]]:
        """Rows in groups that may be captures of their own: the first of `groups`, and others unlike it.

        These are groups of three and more that share no matches with the first, or else all others, where
        they were taken at another time or by another camera; one group where all may belong together.
        """
        first, *others = self.groups or [[]]
        joins = (pair for pair, count in self.shared.items() if count >= FEWEST_MATCHES)
        near = {row for pair in joins if set(first) & set(pair) for row in pair}
        alone = [group for group in others if len(group) > 2 and not near & set(group)]
        rest = sorted(row for group in others for row in group if self.features[row] >= 0)
        if not alone and min(len(first), len(rest)) > 2 and self.apart([first, rest]):
            alone = [rest]
        return [first, *alone]

    def apart(self, groups: Sequence[Sequence[int]]) -> str:
        """Return in words what tells groups of rows apart beside matches; empty where nothing does."""
        exif = self.exif or (ExifFacts(),) * len(self.names)
        found = []
        facts: dict[str, list[object]] = {
            "on other days": [each.taken and each.taken.date() for each in exif],
            "by other cameras": [each.camera or None for each in exif],
            "in other folders": [name.rpartition("/")[0] for name in self.names],
        }
        for kind, of in facts.items():
            seen = [{of[row] for row in group} for group in groups]
            every = set().union(*seen)
            if None not in every and len(every) == sum(map(len, seen)):
                found.append(kind)
        return ", ".join(found)

    def why(self, row: int) -> str:
        """Return the reason why a photograph has no camera."""
        if self.features[row] < 0:
            return UNREADABLE
        if self.features[row] < FEWEST_FEATURES:
            return "too few features (plain, dark, blurred or tiny)"
        neighbours = {
            a + b - row for (a, b), count in self.shared.items() if row in (a, b) and count >= FEWEST_MATCHES
        }
        if not neighbours:
            return "no matches with any other"
        if self.located and not neighbours & self.located:
            return "matches only others that have no camera"
        return "matched, but from one and the same place, or without enough overlap"

    @cached_property
    def gap(self) -> tuple[int, int] | None:
        """Rows of two photographs, one in the first group, between which more would join another group.

        Of those with features, the pair that shares most, or neighbours by name where none shares enough.
        """
        first, *others = (
            [row for row in group if self.features[row] >= FEWEST_FEATURES] for group in self.groups or [[]]
        )
        across = ((min(a, b), max(a, b)) for a in first for group in others for b in group)

        def width(pair: tuple[int, int]) -> tuple[int, int]:
            shared = self.shared.get(pair, 0)
            return (-shared if shared >= FEWEST_MATCHES else 0), pair[1] - pair[0]

        return min(across, key=width, default=None)

    def advice(self) -> str:
        """Return advice in words: where to take more photographs, or to train captures apart."""
        more = f"take more photographs, {SHARING}"
        if self.gap:
            ends, count = " and ".join(map(self._name, self.gap)), self.shared.get(self.gap) or "no"
            more = f"take more photographs between {ends} ({count} matches)"
        elif not self.located and any(len(group) > 1 for group in self.groups):
            more = "they all match, but nothing tells depth: step aside between photographs, do not only turn"
        if len(self.captures) < 2:
            return more
        listed = " and ".join(map(self._listed, self.captures[:3]))
        if apart := self.apart(self.captures):
            return f"{listed} look like captures of their own ({apart}): train each from its own folder"
        return f"if {listed} are captures of their own, train each from its own folder; else {more}"

    def _listed(self, group: list[int]) -> str:
        if group == list(range(group[0], group[-1] + 1)) and len(group) > 2:
            return f"{self._name(group[0])} to {self._name(group[-1])} ({len(group)})"
        return shortened((self._name(row) for row in group), 3, 100)

    def _name(self, row: int) -> str:
        return printable_line(self.names[row], 30)


def read_matches(folder: Path, files: dict[str, Path], located: Collection[str]) -> Matches:
    """Return a workspace's graph of matches; files: by their names there; located: names with a camera."""
    try:
        kept = json.loads((folder / MATCHES).read_bytes())
    except ValueError as error:
        raise FormatError(f"{folder}: its matches are damaged ({error}); delete it and run again") from None
    row = {name: index for index, name in enumerate(files)}
    root = os.path.commonpath([path.parent for path in files.values()])
    return Matches(
        names=tuple(path.relative_to(root).as_posix() for path in files.values()),
        features=tuple(kept["features"].get(name, -1) for name in files),
        pairs=tuple((row[a], row[b], count) for a, b, count in kept["pairs"]),
        located=frozenset(row[name] for name in located),
        exif=tuple(map(exif_facts, files.values())),
    )
