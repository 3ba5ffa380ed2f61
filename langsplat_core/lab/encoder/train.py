"""Training of the small CLIP that comes with the program, from pictures of procedural rooms alone.

Each step shows the model a batch of crops and a sample of phrases, of which ground truth says which are
right, wrong or neither for every crop. Three losses on their cosines: a sigmoid loss about a fixed cosine
`PIVOT`, contrast over phrases and over crops with several right answers, and, for crops that show
something nameable, canonical phrases held at `CANONICAL_COSINE`: above it a phrase is likelier than "object",
below less likely, which is what relevancy asks.
"""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from langsplat_core.io.files import atomic_path
from langsplat_core.lab.config import DemoEncoderConfig
from langsplat_core.lab.encoder.batches import Batch, Sampler
from langsplat_core.lab.encoder.crops import CropSet, read_crops, write_crops
from langsplat_core.lab.encoder.model import (
    begin_from,
    build_model,
    calibrate_canonical,
    export,
    image_features,
    image_vectors,
    normalised,
    text_vectors,
)
from langsplat_core.lab.encoder.phrases import (
    phrase_book,
    vocabulary,
    write_tokenizer,
)
from langsplat_core.progress import Progress
from langsplat_core.scene import CANONICAL_PHRASES

PIVOT = 0.3  # cosine at which a phrase is as likely right as wrong
CANONICAL_COSINE = 0.24  # of a nameable crop with the canonical phrases: doubtful answers pass as found
_SIGMOID_SCALE, _CONTRAST_SCALE = 14.0, 20.0
_KEPT_PATCHES = 0.55  # share of the patches shown to the model during training (FLIP, Li et al. 2023)
_AVERAGING = 0.998  # decay of the running mean of the weights, which is what is saved
SAVE_EVERY = 250  # steps
FLOOR_COSINE = 0.20  # of a nameable crop with the canonical phrases once trained: relevancy 0.5 lies there
_CALIBRATION_CROPS = 2_500


def loss_of(cosines: Tensor, fits: Tensor, nameable: Tensor) -> Tensor:
    """Scalar loss of (B, P) cosines; the first four phrases are the canonical ones. See the module text."""
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
    return (
        positive
        + 0.5 * negative
        + 20 * pinned
        + _contrast(logits, right, wrong)
        + _contrast(logits.T, right.T, wrong.T)
    )


def _contrast(logits: Tensor, right: Tensor, wrong: Tensor) -> Tensor:
    """Mean over right pairs of -log p(right among itself and every wrong one of its row)."""
    others = torch.logsumexp(logits.masked_fill(wrong == 0, -1e4), 1, keepdim=True)
    each = F.softplus(others - logits) * right
    per_row = each.sum(1) / right.sum(1).clamp(min=1)
    return per_row.sum() / (right.sum(1) > 0).sum().clamp(min=1)


def train_demo_encoder(out: Path, config: DemoEncoderConfig, progress: Progress) -> None:
    """Train the demo encoder into folder `out`, in the layout that `transformers` loads.

    Crops and the state of the training are kept in `out`/work and reused by the next call with the same
    settings; `out` itself always holds the latest saved model. The same settings give the same model up
    to rounding, interrupted or not.
    """
    work = out / "work"
    write_crops(work / "crops", config, progress)
    crops, _ = read_crops(work / "crops")
    book = phrase_book(list(crops.labels))
    words = vocabulary(book)
    write_tokenizer(words, out)
    from transformers import CLIPTokenizerFast

    tokenizer = CLIPTokenizerFast.from_pretrained(out)
    token_of = {word: tokenizer.convert_tokens_to_ids(f"{word}</w>") for word in words}
    ends = (tokenizer.bos_token_id, tokenizer.eos_token_id)
    sampler = Sampler(crops, book, token_of, ends)
    torch.manual_seed(config.seed)
    model = build_model(len(tokenizer), *ends)
    if config.start is not None:
        begin_from(model, tokenizer.get_vocab(), config.start)
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


def _nameable(model: Any, crops: CropSet, seed: int) -> Tensor:
    """(M, 512) unit vectors of some crops that show a thing or a part."""
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

    def __init__(self, model: Any, class_counts: list[int], config: DemoEncoderConfig) -> None:
        self.model, self.config, self.step, self.loss = model.train(), config, 0, math.nan
        self.mean = type(model)(model.config)
        self.mean.load_state_dict(model.state_dict())
        # Plain classifiers of the picture, for training only: they teach shapes sooner than phrases do.
        width = model.config.vision_config.hidden_size
        self.heads = nn.ModuleList(nn.Linear(width, count) for count in class_counts)
        every = [*model.parameters(), *self.heads.parameters()]
        matrices = [p for p in every if p.ndim > 1]
        others = [p for p in every if p.ndim <= 1]
        groups = [{"params": matrices, "weight_decay": 0.05}, {"params": others, "weight_decay": 0.0}]
        self.optimiser = torch.optim.AdamW(groups, lr=config.lr, betas=(0.9, 0.98))

    def advance(self, batch: Batch) -> None:
        """One step of AdamW on a warmed-up cosine schedule, in bfloat16 where that is fast."""
        torch.manual_seed(
            self.config.seed * 1_000_003 + self.step
        )  # which patches are shown, also after a resume
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
