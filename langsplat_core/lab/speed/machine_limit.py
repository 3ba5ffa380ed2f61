"""How far blending is from what the machine can do: its float32 multiply-add rate, and what a picture needs.

The need is counted from the float64 footprints, not from any backend: every row of sixteen pixels (cut at
multiples of sixteen, as vector units want them) that a Gaussian's contour meets while one of its pixels still
runs. Comparisons, selections and conversions are instructions too but no floating point operations, and a
row's sixteen lanes count in full; so even perfect code stays well below the whole rate.
"""

import time
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel, shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.cpu.lanes import LANES, lanes, ramp, total
from langsplat_core.raster.reference import Footprints

# Per lane: w (1), log2(height) - w^2 (2), exp2 (range 2, polynomial 5 x 2), T - alpha T (2), weight (1).
_FLOPS_BLEND = 18
_FLOPS_CHANNEL = 2
_CHAINS = 12  # independent sums: enough to hide the latency of two units


@dataclass(frozen=True)
class Need:
    """Work that a picture cannot do without."""

    rows: int  # rows of sixteen pixels visited
    entries: int  # pairs of a pixel and a Gaussian that is blended there: non-zero entries of W

    def flops(self, channels: int) -> int:
        """Floating point operations of a splat of C channels."""
        return self.rows * LANES * (_FLOPS_BLEND + _FLOPS_CHANNEL * channels)


@kernel
def _chains(first: int, last: int, rounds: int, factor: float, out: Array) -> None:
    """Twelve sums of sixteen lanes, each sum = sum * factor + step, `rounds` times."""
    step = ramp()
    times = lanes(np.float32(factor))
    for job in range(first, last):
        a0 = a1 = a2 = a3 = a4 = a5 = a6 = a7 = a8 = a9 = a10 = a11 = lanes(np.float32(job))
        # A step of its own for each, or the compiler sees that all are equal.
        s1, s2, s3, s4, s5, s6 = step + 1.0, step + 2.0, step + 3.0, step + 4.0, step + 5.0, step + 6.0
        s7, s8, s9, s10, s11 = step + 7.0, step + 8.0, step + 9.0, step + 10.0, step + 11.0
        for _ in range(rounds):
            a0, a1, a2, a3 = a0 * times + step, a1 * times + s1, a2 * times + s2, a3 * times + s3
            a4, a5, a6, a7 = a4 * times + s4, a5 * times + s5, a6 * times + s6, a7 * times + s7
            a8, a9, a10, a11 = a8 * times + s8, a9 * times + s9, a10 * times + s10, a11 * times + s11
        out[job] = total(a0 + a1 + a2 + a3 + a4 + a5 + a6 + a7 + a8 + a9 + a10 + a11)


def peak_flops(seconds: float = 0.5) -> float:
    """Float32 operations per second of all cores together, a fused multiply-add counting as two."""
    workers = shared_workers()
    jobs, rounds, factor = 4 * workers.threads, 20_000, np.float32(0.999)
    out = np.empty(jobs, np.float32)
    workers.run(_chains, jobs, 1, factor, out)
    best, stop = 0.0, time.perf_counter() + seconds
    while time.perf_counter() < stop:
        start = time.perf_counter()
        workers.run(_chains, jobs, rounds, factor, out)
        best = max(best, 2.0 * LANES * _CHAINS * jobs * rounds / (time.perf_counter() - start))
    return best


@kernel
def _count(
    order: Array, means: Array, conics: Array, extents: Array, opacities: Array, state: Array, cutoffs: Array
) -> tuple[int, int]:
    """Blend front to back pixel by pixel; state is (H, W) transmittance, negative where a pixel stopped."""
    height, width = state.shape
    alpha_min, alpha_max, transmittance_min = cutoffs[0], cutoffs[1], cutoffs[2]
    rows, entries = 0, 0
    for i in order:
        top = int(max(np.ceil(means[i, 1] - extents[i, 1] - 0.5), 0.0))
        bottom = int(min(np.floor(means[i, 1] + extents[i, 1] - 0.5) + 1, float(height)))
        xx, xy, yy = conics[i, 0], conics[i, 1], conics[i, 2]
        reach = 2 * np.log(opacities[i] / alpha_min)
        for y in range(top, bottom):
            dy = y + 0.5 - means[i, 1]
            # xx dx^2 + 2 xy dx dy + yy dy^2 <= reach
            inside = (xy * dy) ** 2 - xx * (yy * dy * dy - reach)
            if inside < 0:
                continue
            middle, half = means[i, 0] - xy * dy / xx, np.sqrt(inside) / xx
            left = int(max(np.ceil(middle - half - 0.5), 0.0))
            right = int(min(np.floor(middle + half - 0.5) + 1, float(width)))
            segment = -1
            for x in range(left, right):
                before = state[y, x]
                if before <= 0:
                    continue
                if x // 16 != segment:
                    segment = x // 16
                    rows += 1
                dx = x + 0.5 - means[i, 0]
                alpha = opacities[i] * np.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
                alpha = min(alpha, alpha_max)
                if alpha < alpha_min:
                    continue
                after = before * (1 - alpha)
                if after <= transmittance_min:
                    state[y, x] = -before
                else:
                    state[y, x] = after
                    entries += 1
    return rows, entries


def count_need(footprints: Footprints, width: int, height: int, settings: RasterSettings = INRIA) -> Need:
    """What blending these footprints into a width x height picture takes."""
    order = np.argsort(footprints.depths, kind="stable")
    order = order[footprints.opacities[order] > 0]
    rows, entries = _count(
        order,
        footprints.means_px,
        footprints.conics,
        footprints.extents_px,
        footprints.opacities,
        np.ones((height, width)),
        np.array([settings.alpha_min, np.float32(settings.alpha_max), settings.transmittance_min]),
    )
    return Need(int(rows), int(entries))
