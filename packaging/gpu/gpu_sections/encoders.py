"""Encoders and segmenters in their real sizes with random weights: seconds a photograph, device and CPU."""

import tempfile
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

from gpu_sections import Plan, forget_peak, need_cuda, peak_mib, table, wait
from langsplat_core.arrays import Array
from langsplat_core.raster import gsplat
from langsplat_core.semantics.encoders import load_encoder
from langsplat_core.semantics.sam import grid_points, load_segmenter
from tests.support.full_size import MODELS, PHOTOGRAPH

REPEATS = 5  # of a batch of crops: 320, about as many regions as a photograph has
ENLARGED = 16  # masks at once


def measure(plan: Plan) -> Iterator[str]:
    """One table a model."""
    need_cuda()
    yield "# Encoders and segmenters in their real sizes, random weights\n"
    for name in plan.models:
        with tempfile.TemporaryDirectory() as folder:
            torch.manual_seed(0)
            MODELS[name].make(Path(folder))
            compare = _segmenter if MODELS[name].segments else _encoder
            yield f"## {MODELS[name].id}, {MODELS[name].million:g} million weights\n"
            yield compare(folder, plan)


def _encoder(folder: str, plan: Plan) -> str:
    """The crops of a photograph on the device; vectors of some beside the CPU's."""
    forget_peak()
    start = time.perf_counter()
    encoder = load_encoder(folder, gsplat.DEVICE)
    loaded = time.perf_counter() - start
    side = encoder.image_size
    crops = np.random.default_rng(0).integers(0, 256, (plan.crops, side, side, 3), dtype=np.uint8)
    vectors = encoder.encode_images(crops)
    start = time.perf_counter()
    for _ in range(REPEATS):
        encoder.encode_images(crops)
    seconds = time.perf_counter() - start
    memory = peak_mib()
    there = load_encoder(folder, "cpu")
    start = time.perf_counter()
    wanted = there.encode_images(crops)
    slow = (time.perf_counter() - start) * REPEATS
    head = (
        "loading, s",
        f"{REPEATS * plan.crops} crops, s",
        "on the CPU, s",
        "largest error of a vector",
        "device MiB",
    )
    return table(head, [(loaded, seconds, slow, _largest(vectors, wanted), memory)])


def _segmenter(folder: str, plan: Plan) -> str:
    """A photograph, asked at its points, all masks enlarged; one batch of points beside the CPU's."""
    forget_peak()
    start = time.perf_counter()
    segmenter = load_segmenter(folder, gsplat.DEVICE)
    loaded = time.perf_counter() - start
    image = np.random.default_rng(0).integers(0, 256, (*PHOTOGRAPH, 3), dtype=np.uint8)
    points = grid_points(8, PHOTOGRAPH)
    rows = []
    with torch.inference_mode():
        for _ in range(2):  # the first chooses algorithms
            laps = [_now()]
            look = segmenter.look(image)
            laps.append(_now())
            answers = [look.ask(points) for _ in range(plan.batches)]
            laps.append(_now())
            for _, logits in answers:
                for some in logits.flatten(0, 1).split(ENLARGED):
                    torch.gt(look.enlarge(some), 0)  # what a mask is made by
            laps.append(_now())
            rows.append([after - before for before, after in pairwise(laps)])
        memory = peak_mib()
        ious, logits = (part.cpu().numpy() for part in answers[0])
        start = time.perf_counter()
        there = load_segmenter(folder, "cpu").look(image)
        wanted = [part.numpy() for part in there.ask(points)]
        slow = time.perf_counter() - start
    errors = (_largest(ious, wanted[0]), _largest(logits, wanted[1]) / float(np.abs(wanted[1]).max()))
    steps = ("picture", f"{64 * plan.batches} points", f"{192 * plan.batches} masks enlarged", "photograph")
    named = ("loading", *steps, "CPU: loading, picture, 64 points")
    quality = ("error of a quality", "relative error of a mask", "device MiB")
    head = (*(f"{name}, s" for name in named), *quality)
    return table(head, [(loaded, *rows[1], sum(rows[1]), slow, *errors, memory)])


def _now() -> float:
    wait()
    return time.perf_counter()


def _largest(one: Array, two: Array) -> float:
    return float(np.abs(one - two).max())
