"""The draw order found on the device: a radix sort in compute shaders, OpenGL 4.3.

It is the order of `front_to_back`, reversed, to the last bit: camera z is computed in double precision with
the same operations, and the sort is stable. Only `depth_sort.comp.glsl` knows how.
"""

from collections.abc import Mapping
from typing import Literal

import moderngl
import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import BackendError
from langsplat_core.raster.opengl.context import is_software
from langsplat_core.raster.opengl.draw import set_uniforms, shader

GROUP, ROUNDS = 256, 8  # threads of a workgroup, and items that each of them takes
STEPS = ("keys", "count", "scan", "scatter")  # numbered as in the shader
DIGITS, KEY_BITS, DIGIT_BITS = 256, 64, 8
MEAN_BYTES = 24  # of one Gaussian, in the largest buffer
Sort = Literal["auto", "cpu", "device"]  # who finds the draw order
_PROBE = 5000  # points sorted to see whether the driver does it right


class SortBuffers:
    """Device memory to sort n points: 60 bytes each. `rows` becomes the order, `command` the draw of it."""

    def __init__(self, ctx: moderngl.Context, means: Array, rows: moderngl.Buffer) -> None:
        """means: (n, 3) world units; rows: room for n indices, which stays its owner's."""
        n = self.count = len(means)
        self.groups = max(-(-n // (GROUP * ROUNDS)), 1)
        self.rows = rows
        points = np.ascontiguousarray(means, np.float64).tobytes() or bytes(MEAN_BYTES)
        self.means = ctx.buffer(points)
        self.keys, self.other_keys = (ctx.buffer(reserve=8 * max(n, 1)) for _ in range(2))
        self.other_rows = ctx.buffer(reserve=4 * max(n, 1))
        self.counts, self.totals = (
            ctx.buffer(reserve=4 * DIGITS * self.groups),
            ctx.buffer(reserve=4 * DIGITS),
        )
        self.command = ctx.buffer(reserve=20)  # moderngl's stride; the last four bytes are not read

    def order(self) -> Array:
        """(m,) int32 rows of the points that are drawn, back to front, read from the device."""
        drawn = int(np.frombuffer(self.command.read(16), np.uint32)[1])
        return np.frombuffer(self.rows.read(4 * drawn), np.int32) if drawn else np.zeros(0, np.int32)

    def release(self) -> None:
        """Give the device memory back, all but `rows`."""
        own = (
            self.means,
            self.keys,
            self.other_keys,
            self.other_rows,
            self.counts,
            self.totals,
            self.command,
        )
        for buffer in own:
            buffer.release()


class DepthSorter:
    """The compiled sort of one context. Raises moderngl.Error where the driver cannot compile it."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._programs: Mapping[str, moderngl.ComputeShader] = {
            name: ctx.compute_shader(shader("depth_sort.comp", 430, STEP=number, GROUP=GROUP, ROUNDS=ROUNDS))
            for number, name in enumerate(STEPS)
        }

    def holds(self, count: int) -> bool:
        """Whether the driver's buffers are large enough for so many points."""
        return bool(MEAN_BYTES * count <= self._ctx.info["GL_MAX_SHADER_STORAGE_BLOCK_SIZE"])

    def sort(self, buffers: SortBuffers, plane: Array, near: float, far: float) -> None:
        """Order by camera z, far ones first, ties by descending index, those within (near, far] alone.

        plane: (4,) third row of the camera's world to camera matrix.
        """
        b = buffers
        b.command.write(np.array([4, 0, 0, 0, 0], np.uint32))
        for binding, buffer in ((0, b.means), (5, b.counts), (6, b.totals), (7, b.command)):
            buffer.bind_to_storage_buffer(binding)
        self._bind(b.keys, b.rows, b.other_keys, b.other_rows)
        values: dict[str, object] = {
            "plane": tuple(plane),
            "near": near,
            "far": far,
            "items": b.count,
            "groups": b.groups,
        }
        self._run("keys", max(-(-b.count // GROUP), 1), values)
        here, there = (b.keys, b.rows), (b.other_keys, b.other_rows)
        for shift in range(0, KEY_BITS, DIGIT_BITS):  # an even number of passes: they end in `rows`
            self._bind(*here, *there)
            digit = values | {"digit_word": shift // 32, "digit_shift": shift % 32}
            for step, groups in (("count", b.groups), ("scan", DIGITS), ("scatter", b.groups)):
                self._run(step, groups, digit)
            here, there = there, here

    @staticmethod
    def _bind(*buffers: moderngl.Buffer) -> None:
        for binding, buffer in enumerate(buffers, 1):
            buffer.bind_to_storage_buffer(binding)

    def _run(self, step: str, groups: int, values: dict[str, object]) -> None:
        set_uniforms(self._programs[step], values)
        self._programs[step].run(groups)
        self._ctx.memory_barrier()

    def is_right(self) -> bool:
        """Whether a small sort comes out right: drivers are known to get such shaders wrong."""
        depths = np.random.default_rng(0).integers(-2, 60, _PROBE) * np.pi
        means = np.zeros((_PROBE, 3))
        means[:, 2] = depths
        rows = self._ctx.buffer(reserve=4 * _PROBE)
        buffers = SortBuffers(self._ctx, means, rows)
        self.sort(buffers, np.array([0.0, 0.0, 1.0, 0.0]), 0.2, 150.0)
        found = buffers.order()
        buffers.release()
        rows.release()
        ahead = np.flatnonzero((depths > 0.2) & (depths <= 150.0))
        return np.array_equal(found, ahead[np.argsort(depths[ahead], kind="stable")][::-1])

    def release(self) -> None:
        """Give the programs back."""
        for program in self._programs.values():
            program.release()


def working_sorter(ctx: moderngl.Context) -> DepthSorter | None:
    """A sorter that was seen to sort; None where the driver has no compute shaders or fails at them."""
    if ctx.version_code < 430:
        return None
    try:
        sorter = DepthSorter(ctx)
    except moderngl.Error:
        return None
    if sorter.is_right():
        return sorter
    sorter.release()
    return None


def chosen_sorter(ctx: moderngl.Context, sort: Sort) -> DepthSorter | None:
    """None where the CPU is to sort. "auto": a sorter that works, but none on a driver that runs on the CPU,
    where NumPy is faster. BackendError for "device" where there is none."""
    if sort == "cpu" or (sort == "auto" and is_software(ctx)):
        return None
    sorter = working_sorter(ctx)
    if sorter is None and sort == "device":
        raise BackendError("this driver cannot sort: older than OpenGL 4.3, or its compute shaders fail")
    return sorter
