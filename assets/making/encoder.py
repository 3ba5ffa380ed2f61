"""The demo encoder: a small CLIP that comes with the program, trained on images of procedural rooms alone.

Each step shows the model a batch of crops and a sample of phrases, of which ground truth says which are
right, wrong or neither for every crop. Three losses on their cosines: a sigmoid loss about a fixed cosine
`PIVOT`, contrast over phrases and over crops with several right answers, and, for crops that show something
nameable, canonical phrases held at `CANONICAL_COSINE`: above it a phrase is likelier than "object", below
less likely, which is what relevancy asks.
"""

import json
import math
from collections import Counter
from dataclasses import asdict, dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional as F

from assets.making.crops import CROP, CropSet, EncoderConfig, read_crops, write_crops
from assets.making.kit import COLOURS
from assets.making.objects import TABLE_TOP
from assets.making.world import (
    BULK,
    MATERIALS,
    RegionLabel,
    colour_phrases,
    material_part_phrases,
    material_phrases,
    material_whole_phrases,
    object_words,
    part_phrases,
    whole_phrases,
)
from langsplat_core.arrays import Array
from langsplat_core.io.files import atomic_path
from langsplat_core.progress import Progress
from langsplat_core.scene import CANONICAL_PHRASES, LanguageField
from langsplat_core.semantics.encoders import Encoder as ImageTextEncoder
from langsplat_core.semantics.encoders import load_encoder
from langsplat_core.semantics.relevancy import FLOOR, relevancy_of

FUNCTION_WORDS = ("a", "an", "the", "of", "and", "with", "photo", "my", "on", "in", "some", "one")
PREFIXES = ("", "", "", "", "a", "the", "the", "a photo of a", "a photo of the", "my", "one", "some")
CONTEXT = 16  # tokens of the longest phrase, with start and end
START, END, WORD_END = "<|startoftext|>", "<|endoftext|>", "</w>"
MEAN, STD = (0.32, 0.28, 0.25), (0.30, 0.28, 0.27)  # of the training crops, black surroundings included
_CALIBRATION_STEPS = 200
_WHOLE_WEIGHT = 8.0  # crops of small objects are drawn this much more often than others of their count
PIVOT = 0.3  # cosine at which a phrase is as likely right as wrong
CANONICAL_COSINE = 0.24  # of a nameable crop with the canonical phrases: doubtful answers pass as found
_SIGMOID_SCALE, _CONTRAST_SCALE = 14.0, 20.0
_KEPT_PATCHES = 0.55  # share of the patches shown to the model during training (FLIP, Li et al. 2023)
_AVERAGING = 0.998  # decay of the running mean of the weights, which is what is saved
SAVE_EVERY = 250  # steps
FLOOR_COSINE = 0.20  # of a nameable crop with the canonical phrases once trained: relevancy 0.5 lies there
_CALIBRATION_CROPS = 2_500


BOOK_KINDS = ("colour", "material", "object", "colour+object", "material+object", "part")


@dataclass(frozen=True, eq=False)
class PhraseBook:
    """Table of all phrases of a training run, and how each fits each distinct label."""

    phrases: tuple[str, ...]  # P; the four canonical phrases come first
    kinds: tuple[str, ...]  # (P) "canonical", one of BOOK_KINDS
    labels: tuple[RegionLabel, ...]  # U distinct labels
    fits: Array  # (U, P) int8: 1 right, 0 wrong, -1 neither (left out of the loss)


def phrase_book(labels: list[RegionLabel]) -> PhraseBook:
    """Return the phrases for a set of labels, and every object in every colour beside them."""
    distinct = tuple(dict.fromkeys(labels))
    kinds = _kinds(distinct)
    phrases = tuple(kinds)
    column = {phrase: k for k, phrase in enumerate(phrases)}
    fits = np.stack([_row(label, column) for label in distinct])
    return PhraseBook(phrases, tuple(kinds.values()), distinct, fits)


def _kinds(labels: tuple[RegionLabel, ...]) -> dict[str, str]:
    """Every phrase and its kind, the canonical ones first; a phrase of several kinds has the first."""
    kinds: dict[str, str] = dict.fromkeys(CANONICAL_PHRASES, "canonical")
    for colour in COLOURS:
        kinds.update(dict.fromkeys(colour_phrases(colour), "colour"))
    for material in sorted({label.material for label in labels if label.material}):
        kinds.update(dict.fromkeys(material_phrases(material), "material"))
    for thing in sorted({label.thing for label in labels if label.thing}):
        kinds.update({name: kinds.get(name, "object") for name in whole_phrases(thing, "")})
        for colour in COLOURS:
            for name in whole_phrases(thing, colour):
                kinds.setdefault(name, "colour+object")
    wholes = [label for label in labels if label.level == 2]
    for name in chain.from_iterable(material_whole_phrases(label.thing, label.material) for label in wholes):
        kinds.setdefault(name, "material+object")
    for name in chain.from_iterable(label.names for label in labels):
        kinds.setdefault(name, "part")
    return kinds


def _row(label: RegionLabel, column: dict[str, int]) -> Array:
    """Return (P,) int8 of one label: 1 right, 0 wrong, -1 neither."""
    row = np.zeros(len(column), np.int8)

    def mark(phrases: list[str] | tuple[str, ...], value: int) -> None:
        row[[column[phrase] for phrase in phrases if phrase in column]] = value

    if label.thing and label.level < 2 and label.word in BULK:
        for colour in ("", label.colour, label.thing_colour):  # the body of a mug may pass for a mug
            mark(whole_phrases(label.thing, colour), -1)
    if label.level == 2:
        for bulk in BULK:
            mark(part_phrases(bulk, label.thing, label.colour, label.colour), -1)
    unknown = COLOURS if not label.colour else label.hues
    for hue in unknown:
        mark(colour_phrases(hue), -1)
        if not label.colour:
            mark([f"{hue} {name}" for name in (*object_words(label.thing), label.word)], -1)
    known = label.materials and "" not in label.materials
    for material in label.materials if known else MATERIALS:
        mark(material_phrases(material), -1)
        mark(material_whole_phrases(label.thing, material), -1)
        mark(material_part_phrases(label.word, label.thing, material), -1)
    mark(label.names, 1)
    mark(colour_phrases(label.colour), 1)
    mark(material_phrases(label.material), 1)
    if label.level == -1 and not label.colour:
        mark(CANONICAL_PHRASES, 1)
    return row


def word_list(book: PhraseBook) -> list[str]:
    """Return all words of the phrases, and the function words, in alphabetical order."""
    return sorted({word for phrase in book.phrases for word in phrase.split()} | set(FUNCTION_WORDS))


def write_tokenizer(words: list[str], folder: Path) -> None:
    """Write a CLIP tokenizer (byte-pair encoding) with one token for every word, and the word list.

    Letters are tokens too, so any other word is spelled out rather than refused. The same words always
    give the same token numbers, so a resumed training finds its embeddings where they were.
    """
    from transformers import CLIPTokenizerFast

    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    merges = word_merges(words)
    tokens = [START, END, *letters, *(letter + WORD_END for letter in letters)]
    tokens += [left + right for left, right in merges]
    vocab = {token: number for number, token in enumerate(dict.fromkeys(tokens))}
    tokenizer = CLIPTokenizerFast(vocab=vocab, merges=merges, model_max_length=CONTEXT)
    folder.mkdir(parents=True, exist_ok=True)
    tokenizer.save_pretrained(folder)
    (folder / "vocabulary.txt").write_text("\n".join(words) + "\n", encoding="utf-8")


def word_merges(words: list[str]) -> list[tuple[str, str]]:
    """Byte-pair merges, in order, after which every word is one symbol (Sennrich et al. 2016).

    The commonest pair is merged first, the alphabet decides between equals. Words are of letters a-z.
    """
    spelled = [[*word[:-1], word[-1] + WORD_END] for word in words]
    merges: list[tuple[str, str]] = []
    while any(len(symbols) > 1 for symbols in spelled):
        pairs = Counter(pair for symbols in spelled for pair in pairwise(symbols))
        best = min(pairs, key=lambda pair: (-pairs[pair], pair))
        merges.append(best)
        spelled = [_merged(symbols, best) for symbols in spelled]
    return merges


def _merged(symbols: list[str], pair: tuple[str, str]) -> list[str]:
    """`symbols` with every occurrence of `pair`, from the left, made one symbol."""
    result: list[str] = []
    for symbol in symbols:
        if result and (result[-1], symbol) == pair:
            result[-1] += symbol
        else:
            result.append(symbol)
    return result


def build_model(tokens: int, start: int, end: int) -> Any:
    """Return a `transformers.CLIPModel` of 2.4 million weights for a vocabulary of `tokens`."""
    from transformers import CLIPConfig, CLIPModel

    text = {
        "vocab_size": tokens, "hidden_size": 128, "intermediate_size": 512, "num_hidden_layers": 3,
        "num_attention_heads": 4, "max_position_embeddings": CONTEXT, "projection_dim": 512,
        "bos_token_id": start, "eos_token_id": end, "pad_token_id": end,
    }  # fmt: skip
    vision = {
        "hidden_size": 160, "intermediate_size": 640, "num_hidden_layers": 5, "num_attention_heads": 5,
        "image_size": CROP, "patch_size": 8, "projection_dim": 512,
    }  # fmt: skip
    model = CLIPModel(CLIPConfig(text_config=text, vision_config=vision, projection_dim=512))
    model.set_attn_implementation("eager")  # on a CPU the fused one is four times slower to differentiate
    return model


def normalised(crops: Array) -> Tensor:
    """Return (B, 3, 64, 64) float32 images as the encoder takes them, of (B, 64, 64, 3) uint8."""
    pixels = torch.from_numpy(np.ascontiguousarray(crops)).permute(0, 3, 1, 2).float() / 255
    return (pixels - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)


def image_features(model: Any, pixels: Tensor, keep: float = 1.0) -> Tensor:
    """Return (B, 160) features before the projection.

    keep: share of the patches that the model is shown, drawn at random but rather those that are not all
    black surroundings.
    """
    vision = model.vision_model
    hidden = vision.embeddings(pixels)
    if keep < 1:
        size = vision.config.patch_size
        spread = F.max_pool2d(pixels, size) + F.max_pool2d(-pixels, size)  # brightest less darkest
        score = torch.rand(len(hidden), hidden.shape[1] - 1) + (spread.amax(1).flatten(1) > 0.2) * 0.7
        order = score.argsort(1, descending=True)[:, : round(keep * score.shape[1])] + 1
        order = torch.cat([torch.zeros(len(hidden), 1, dtype=torch.long), order], 1)
        hidden = hidden.gather(1, order[..., None].expand(-1, -1, hidden.shape[2]))
    hidden = vision.encoder(inputs_embeds=vision.pre_layrnorm(hidden)).last_hidden_state[:, 0]
    return vision.post_layernorm(hidden)


def image_vectors(model: Any, features: Tensor) -> Tensor:
    """Return (B, 512) unit vectors of `image_features`."""
    return F.normalize(model.visual_projection(features).float(), dim=-1)


def text_vectors(model: Any, tokens: Tensor) -> Tensor:
    """Return (P, 512) unit vectors of (P, L) tokens."""
    pooled = model.text_model(input_ids=tokens).pooler_output
    return F.normalize(model.text_projection(pooled).float(), dim=-1)


def calibrate_canonical(model: Any, tokens: Tensor, images: Tensor, cosine: float) -> None:
    """Move the word vectors of the canonical phrases until their mean cosine with `images` is `cosine`.

    tokens: (4, L) int64, one word each, behind the start token; images: (M, 512) unit vectors of crops that
    show something nameable. Relevancy 0.5 then lies where a user wants it, between right and wrong phrases.
    """
    rows = tokens[:, 1]
    words = model.text_model.embeddings.token_embedding.weight.detach().float()
    moved = torch.zeros(len(rows), words.shape[1], requires_grad=True)
    optimiser = torch.optim.Adam([moved], lr=0.02)
    for _ in range(_CALIBRATION_STEPS):
        weights = {"embeddings.token_embedding.weight": words.index_add(0, rows, moved)}
        pooled = functional_call(model.text_model, weights, kwargs={"input_ids": tokens}).pooler_output
        texts = F.normalize(model.text_projection(pooled).float(), dim=-1)
        loss = ((images @ texts.T - cosine) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        model.text_model.embeddings.token_embedding.weight.index_add_(0, rows, moved.detach())


def export(model: Any, out: Path) -> None:
    """Write `model` in half precision, its configuration and how images are normalised."""
    from safetensors.torch import save_file

    weights = {name: tensor.detach().half().contiguous() for name, tensor in model.state_dict().items()}
    with atomic_path(out / "model.safetensors") as path:
        save_file(weights, path, metadata={"format": "pt"})
    model.config.architectures = [type(model).__name__]
    model.config.save_pretrained(out)
    settings = {
        "image_processor_type": "CLIPImageProcessor",
        "image_mean": MEAN, "image_std": STD, "rescale_factor": 1 / 255,
        "do_center_crop": True, "do_convert_rgb": True, "do_normalize": True, "do_rescale": True,
        "do_resize": True, "resample": 2,
        "crop_size": {"height": CROP, "width": CROP}, "size": {"shortest_edge": CROP},
    }  # fmt: skip
    (out / "preprocessor_config.json").write_text(json.dumps(settings, indent=2) + "\n", encoding="utf-8")


@dataclass(frozen=True, eq=False)
class Batch:
    """Data of one training step."""

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

    def batch(self, config: EncoderConfig, rng: np.random.Generator) -> Batch:
        """Return the next batch of `config.batch` crops and `config.phrases` phrases."""
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
    """Return (U, 3) rows of every label's object, region and colour word, -100 for none; how many of each."""
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
    """Turn, stretch and shift images, change their exposure, and now and then cover a part."""
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


def loss_of(cosines: Tensor, fits: Tensor, nameable: Tensor) -> Tensor:
    """Scalar loss of (B, P) cosines, described above; the first four phrases are the canonical ones."""
    canonical = len(CANONICAL_PHRASES)
    right, wrong = (fits == 1).float(), (fits == 0).float()
    held = torch.zeros_like(wrong)
    held[:, :canonical] = nameable[:, None].float()
    wrong = wrong * (1 - held)
    margin = _SIGMOID_SCALE * (cosines - PIVOT)
    positive = (F.softplus(-margin) * right).sum() / len(cosines)
    negative = (F.softplus(margin) * wrong).sum() / len(cosines)
    pinned = (((cosines - CANONICAL_COSINE) ** 2) * held).sum() / held.sum().clamp(min=1)
    logits = _CONTRAST_SCALE * cosines
    contrast = _contrast(logits, right, wrong), _contrast(logits.T, right.T, wrong.T)
    return positive + 0.5 * negative + 20 * pinned + contrast[0] + contrast[1]


def _contrast(logits: Tensor, right: Tensor, wrong: Tensor) -> Tensor:
    """Mean over right pairs of -log p(right among itself and every wrong one of its row)."""
    others = torch.logsumexp(logits.masked_fill(wrong == 0, -1e4), 1, keepdim=True)
    each = F.softplus(others - logits) * right
    per_row = each.sum(1) / right.sum(1).clamp(min=1)
    return per_row.sum() / (right.sum(1) > 0).sum().clamp(min=1)


@dataclass(frozen=True)
class KindReport:
    """Figures for the phrases of one kind."""

    kind: str  # one of BOOK_KINDS
    phrases: int  # that compete
    top1: float  # share of crops whose best phrase of this kind is a right one
    right_found: float  # share of right pairs with relevancy >= the floor
    wrong_found: float  # share of wrong pairs with relevancy >= the floor
    separation: float  # probability that a right pair has more relevancy than a wrong one (ROC area)


def report(encoder: ImageTextEncoder, crops: CropSet) -> list[KindReport]:
    """Figures on `crops` among all their phrases, for each kind of phrase that is right for some crop.

    Pairs that are neither right nor wrong are left out.
    """
    book = phrase_book(list(crops.labels))
    images = encoder.encode_images(crops.images)
    texts = encoder.encode_texts(list(book.phrases))
    canonical = encoder.encode_texts(list(CANONICAL_PHRASES))
    row_of = {label: row for row, label in enumerate(book.labels)}
    fits = book.fits[[row_of[label] for label in crops.labels]]
    kinds = np.array(book.kinds)
    rows = []
    for kind in BOOK_KINDS:
        columns = np.flatnonzero(kinds == kind)
        if (fits[:, columns] == 1).any():
            zero, rate = (images @ canonical.T).max(1, keepdims=True), LanguageField.temperature
            scores = relevancy_of(images @ texts[columns].T, zero, rate)
            rows.append(_kind_report(kind, scores, fits[:, columns]))
    return rows


def _kind_report(kind: str, scores: Array, fits: Array) -> KindReport:
    usable = (fits == 1).any(1)
    scores, fits = scores[usable], fits[usable]
    best = np.where(fits >= 0, scores, -1.0).argmax(1)
    right, wrong = scores[fits == 1], scores[fits == 0]
    top1 = (fits[np.arange(len(fits)), best] == 1).mean()
    separation = np.searchsorted(np.sort(wrong), right).mean() / len(wrong)
    found = ((right >= FLOOR).mean(), (wrong >= FLOOR).mean())
    return KindReport(kind, scores.shape[1], float(top1), float(found[0]), float(found[1]), float(separation))


def report_table(rows: list[KindReport]) -> str:
    """Return the report as a table of Markdown."""
    head = "| kind of phrase | phrases | best phrase is right | right ones found | wrong ones found |"
    lines = [
        f"| {row.kind} | {row.phrases} | {row.top1:.0%} | {row.right_found:.0%} | {row.wrong_found:.1%} |"
        for row in rows
    ]
    return "\n".join([head, "|---|---|---|---|---|", *lines])


def train_encoder(out: Path, config: EncoderConfig, progress: Progress) -> list[KindReport]:
    """Train the demo encoder into folder `out`, in the layout that `transformers` loads.

    Returns its figures on crops of rooms that it was not trained in. Crops and the state of the training are
    kept in `out`/work and reused by the next call with the same settings; `out` itself always holds the
    latest saved model. The same settings give the same model up to rounding, interrupted or not.
    """
    work = out / "work"
    write_crops(work / "crops", config, progress)
    crops, held_out = read_crops(work / "crops")
    book = phrase_book(list(crops.labels))
    words = word_list(book)
    write_tokenizer(words, out)
    from transformers import CLIPTokenizerFast

    tokenizer = CLIPTokenizerFast.from_pretrained(out)
    token_of = {word: tokenizer.convert_tokens_to_ids(f"{word}</w>") for word in words}
    ends = (tokenizer.bos_token_id, tokenizer.eos_token_id)
    sampler = Sampler(crops, book, token_of, ends)
    torch.manual_seed(config.seed)
    model = build_model(len(tokenizer), *ends)
    run = _Run(model, sampler.class_counts, config)
    run.resume(work / "state.pt")
    while run.step < config.steps:
        run.advance(sampler.batch(config, np.random.default_rng((config.seed, 17, run.step))))
        progress("training", run.step / config.steps, f"step {run.step}", loss=run.loss)
        if run.step % SAVE_EVERY == 0 or run.step == config.steps:
            run.save(work / "state.pt")
            export(run.mean, out)
    canonical = tokenizer(list(CANONICAL_PHRASES), return_tensors="pt", padding=True).input_ids
    calibrate_canonical(run.mean, canonical, _nameable(run.mean, crops, config.seed), FLOOR_COSINE)
    export(run.mean, out)
    return report(load_encoder(str(out), "cpu"), held_out)


def _nameable(model: Any, crops: CropSet, seed: int) -> Tensor:
    """Return (M, 512) unit vectors of some crops that show a thing or a part."""
    rows = [row for row, label in enumerate(crops.labels) if label.thing] or list(range(len(crops.labels)))
    chosen = np.random.default_rng((seed, 19)).permutation(rows)[:_CALIBRATION_CROPS]
    with torch.no_grad():
        parts = [
            image_vectors(model, image_features(model, normalised(crops.images[chosen[start : start + 256]])))
            for start in range(0, len(chosen), 256)
        ]
    return torch.cat(parts)


class _Run:
    """Model, running mean of its weights, and optimiser."""

    def __init__(self, model: Any, class_counts: list[int], config: EncoderConfig) -> None:
        self.model, self.config, self.step, self.loss = model.train(), config, 0, math.nan
        self.mean = type(model)(model.config)
        self.mean.load_state_dict(model.state_dict())
        # Plain classifiers of the image, for training only: they teach shapes sooner than phrases do.
        width = model.config.vision_config.hidden_size
        self.heads = nn.ModuleList(nn.Linear(width, count) for count in class_counts)
        every = [*model.parameters(), *self.heads.parameters()]
        matrices = [p for p in every if p.ndim > 1]
        others = [p for p in every if p.ndim <= 1]
        groups = [{"params": matrices, "weight_decay": 0.05}, {"params": others, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.98))

    def advance(self, batch: Batch) -> None:
        """Take a step of AdamW on a warmed-up cosine schedule, in bfloat16 where that is fast."""
        # Decides which patches are shown, also after a resume.
        torch.manual_seed(self.config.seed * 1_000_003 + self.step)
        warm, done = min(1.0, (self.step + 1) / 300), self.step / self.config.steps
        for group in self.optimiser.param_groups:
            group["lr"] = self.config.lr * warm * (0.02 + 0.98 * 0.5 * (1 + math.cos(math.pi * done)))
        with torch.autocast("cpu", torch.bfloat16):
            keep = _KEPT_PATCHES if done < 0.85 else 1.0
            features = image_features(self.model, batch.pixels, keep)
            images = image_vectors(self.model, features)
            texts = text_vectors(self.model, batch.tokens)
        loss = loss_of(images @ texts.T, batch.fits, batch.nameable)
        for head, target in zip(self.heads, batch.classes.T, strict=True):
            if (target >= 0).any():
                loss = loss + F.cross_entropy(head(features.float()), target)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self.optimiser.step()
        self.step, self.loss = self.step + 1, float(loss.detach())
        decay = min(_AVERAGING, self.step / (self.step + 20))
        with torch.no_grad():
            for mean, now in zip(self.mean.parameters(), self.model.parameters(), strict=True):
                mean.lerp_(now, 1 - decay)

    def save(self, path: Path) -> None:
        """Write everything needed to go on."""
        state = {
            "config": json.dumps(asdict(self.config), default=str), "step": self.step,
            "model": self.model.state_dict(),
            "mean": self.mean.state_dict(), "heads": self.heads.state_dict(),
            "optimiser": self.optimiser.state_dict(),
        }  # fmt: skip
        with atomic_path(path) as temporary:
            torch.save(state, temporary)

    def resume(self, path: Path) -> None:
        """Go on from `path` if it is there and was made with the same settings."""
        if not path.exists():
            return
        state = torch.load(path, weights_only=True)
        if state["config"] != json.dumps(asdict(self.config), default=str):
            return
        self.step = state["step"]
        self.model.load_state_dict(state["model"])
        self.mean.load_state_dict(state["mean"])
        self.heads.load_state_dict(state["heads"])
        self.optimiser.load_state_dict(state["optimiser"])
