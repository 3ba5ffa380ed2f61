"""Batches for training the demo encoder: crops, a sample of phrases, and which of these fit which crop."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from langsplat_core.arrays import Array
from langsplat_core.lab.config import DemoEncoderConfig
from langsplat_core.lab.encoder.crops import CropSet
from langsplat_core.lab.encoder.model import MEAN, STD, normalised
from langsplat_core.lab.encoder.phrases import PREFIXES, PhraseBook
from langsplat_core.lab.world.objects.catalogue import TABLE_TOP
from langsplat_core.scene import CANONICAL_PHRASES

_WHOLE_WEIGHT = 8.0  # crops of small objects are drawn this much more often than others of their count


@dataclass(frozen=True, eq=False)
class Batch:
    """One training step's worth of data."""

    pixels: Tensor  # (B, 3, 64, 64) float32, normalised
    tokens: Tensor  # (P, L) int64, padded with the end token
    fits: Tensor  # (B, P) int8: 1 right, 0 wrong, -1 neither
    nameable: Tensor  # (B,) bool: False for clutter
    classes: Tensor  # (B, 3) int64 rows of the object's, the region's and the colour's word, -100 for none


class Sampler:
    """Draws batches: crops of rare words more often, one right phrase per crop, and random others."""

    def __init__(
        self, crops: CropSet, book: PhraseBook, token_of: dict[str, int], ends: tuple[int, int]
    ) -> None:
        self._crops = crops
        self._book = book
        row_of = {label: row for row, label in enumerate(book.labels)}
        self._rows = np.array([row_of[label] for label in crops.labels])
        keys = [(label.word, label.thing, label.level) for label in crops.labels]
        count = Counter(keys)
        # Rare words more often; whole things on the table most, for they are what people ask for.
        whole = [_WHOLE_WEIGHT if level == 2 and word in TABLE_TOP else 1.0 for word, _, level in keys]
        weight = np.array([count[key] ** -0.6 for key in keys]) * whole
        self._weight = weight / weight.sum()
        self._start, self._end = ends
        self._tokens = [[token_of[word] for word in phrase.split()] for phrase in book.phrases]
        self._prefixes = [[token_of[word] for word in prefix.split()] for prefix in PREFIXES]
        kinds = np.array(book.kinds)
        self._kind_rows = [np.flatnonzero(kinds == kind) for kind in dict.fromkeys(book.kinds)]
        self._right = [self._right_by_kind(row) for row in range(len(book.labels))]
        self._classes, self.class_counts = _word_classes(book)

    def _right_by_kind(self, row: int) -> list[Array]:
        fits = self._book.fits[row]
        groups = [rows[fits[rows] == 1] for rows in self._kind_rows]
        return [group for group in groups if len(group)]

    def batch(self, config: DemoEncoderConfig, rng: np.random.Generator) -> Batch:
        """The next batch of `config.batch` crops and `config.phrases` phrases."""
        chosen = rng.choice(len(self._rows), config.batch, p=self._weight)
        canonical = len(CANONICAL_PHRASES)
        phrases = list(range(canonical))
        for row in self._rows[chosen]:
            groups = self._right[row]
            phrases.append(int(rng.choice(groups[rng.integers(len(groups))])))
        spare = rng.choice(len(self._book.phrases), config.phrases, replace=False)
        unique = list(dict.fromkeys([*phrases, *map(int, spare)]))[: canonical + config.phrases]
        rows = np.asarray(self._rows[chosen])
        fits = torch.from_numpy(self._book.fits[rows][:, unique])
        clutter = self._book.fits[rows][:, 0] == 1
        pixels = _jitter(normalised(_flipped(self._crops.images[chosen], rng)), rng)
        tokens = self._padded([self._dressed(k, rng) for k in unique])
        classes = torch.from_numpy(self._classes[rows])
        return Batch(pixels, tokens, fits, torch.from_numpy(~clutter), classes)

    def _dressed(self, phrase: int, rng: np.random.Generator) -> list[int]:
        """Tokens of a phrase with an article before it now and then; canonical phrases stay bare."""
        prefix = self._prefixes[rng.integers(len(self._prefixes))] if phrase >= len(CANONICAL_PHRASES) else []
        return [self._start, *prefix, *self._tokens[phrase], self._end]

    def _padded(self, rows: list[list[int]]) -> Tensor:
        longest = max(map(len, rows))
        return torch.tensor([row + [self._end] * (longest - len(row)) for row in rows])


def _word_classes(book: PhraseBook) -> tuple[Array, list[int]]:
    """(U, 3) rows of every label's object, region and colour word, -100 for none; how many of each."""
    columns, counts = [], []
    for field in ("thing", "word", "colour"):
        words = [getattr(label, field) for label in book.labels]
        row_of = {word: row for row, word in enumerate(sorted(set(words) - {""}))}
        columns.append([row_of.get(word, -100) for word in words])
        counts.append(max(len(row_of), 1))
    return np.array(columns).T.copy(), counts


def _flipped(images: Array, rng: np.random.Generator) -> Array:
    mirror = rng.random(len(images)) < 0.5
    return np.where(mirror[:, None, None, None], images[:, :, ::-1], images)


def _jitter(pixels: Tensor, rng: np.random.Generator) -> Tensor:
    """Every picture turned, stretched, shifted, its exposure changed, and now and then partly covered."""
    count, size = len(pixels), pixels.shape[-1]
    black = -torch.tensor(MEAN).view(3, 1, 1) / torch.tensor(STD).view(3, 1, 1)
    angle, shear = rng.normal(0, 0.2, count), rng.normal(0, 0.08, count)
    scale = np.exp(rng.normal(0.03, 0.1, (count, 2)))
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([c, shear - s], 1), np.stack([s, c], 1)], 1) * scale[:, :, None]
    maps = np.concatenate([turn, rng.normal(0, 0.06, (count, 2, 1))], 2)
    grid = F.affine_grid(torch.from_numpy(maps.astype(np.float32)), list(pixels.shape), align_corners=False)
    gain = torch.from_numpy(rng.normal(1, 0.06, (count, 1, 1, 1)).astype(np.float32))
    light = F.grid_sample((pixels - black) * gain, grid, align_corners=False)  # zero, black, outside
    for row in np.flatnonzero(rng.random(count) < 0.25):
        y, x = rng.integers(0, size - 12, 2)
        height, width = rng.integers(8, 28, 2)
        light[row, :, y : y + height, x : x + width] = 0
    return light + black
