"""Photographs of a `World` by ray casting: soft key light, sky light with occlusion, small highlights.

Light is gathered once per vertex with a fixed sample set, so every view sees the same shadows.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.datasets.synthetic.colours import to_display, to_linear
from langsplat_core.datasets.synthetic.textures import surface_colour
from langsplat_core.datasets.synthetic.world import World
from langsplat_core.scene import Camera

_OCCLUSION_REACH = 0.45  # metres: surfaces farther away do not darken the sky light
_SKY, _GROUND, _KEY = (0.46, 0.50, 0.56), (0.32, 0.29, 0.26), (1.10, 1.02, 0.90)  # linear light


@dataclass(frozen=True, eq=False)
class Picture:
    """One rendered view."""

    image: Array  # (H, W, 3) uint8 sRGB
    pieces: Array  # (H, W) int32 row of `World.ids` at each pixel's centre, -1 where no surface is
    depth: Array  # (H, W) float32 metres along the camera's z axis, inf where no surface is


@dataclass(frozen=True, eq=False)
class Light:
    """A rectangular lamp above the table, and how much sky there is."""

    position: Array  # (3,) metres
    size: float = 0.55  # side of the square lamp, metres
    key: float = 1.0  # strength of the lamp
    sky: float = 1.0  # strength of the sky


class Renderer:
    """Holds the ray tracer and the light that reaches every vertex."""

    def __init__(self, world: World, light: Light, samples: int = 32) -> None:
        """`samples`: rays per vertex for the sky and again for the lamp."""
        import open3d

        o3d: Any = open3d  # its type stubs do not know that a tensor can be made of an array alone
        self._tensor = o3d.core.Tensor
        self._world = world
        self._light = light
        self._tracer = o3d.t.geometry.RaycastingScene(1)
        self._tracer.add_triangles(
            self._tensor(np.ascontiguousarray(world.vertices)),
            self._tensor(np.ascontiguousarray(world.triangles.astype(np.uint32))),
        )
        # Off the surface, and where it faces the lamp a little towards it, so that vertices in a corner are
        # not inside a wall. A surface that faces away would be pushed into its own object: it would be black.
        inwards = _unit(light.position - world.vertices)
        facing = np.clip((inwards * world.normals).sum(1, keepdims=True), 0, 1)
        self._origins = (world.vertices + 2e-3 * world.normals + 4e-3 * facing * inwards).astype(np.float32)
        self._key = self._lamp_light(samples)
        self._sky = self._sky_light(samples)

    def _blocked(self, origins: Array, directions: Array, reach: float) -> Array:
        """(N,) distance to the first surface over `reach`, in [0, 1]; 1 where nothing is within reach."""
        rays = np.concatenate([origins, directions], 1).astype(np.float32)
        hit = self._tracer.cast_rays(self._tensor(rays), nthreads=1)["t_hit"].numpy()
        return np.minimum(hit / reach, 1.0)

    def _lamp_light(self, samples: int) -> Array:
        """(V,) share of the lamp that each vertex sees, times the cosine of incidence."""
        world, rng = self._world, np.random.default_rng(5)
        total = np.zeros(len(world.vertices), np.float32)
        origins = self._origins
        grid = (np.arange(samples) + rng.random(samples)) / samples
        for u, v in zip(grid, rng.permutation(grid), strict=True):
            spot = self._light.position + self._light.size * np.array([u - 0.5, v - 0.5, 0])
            towards = (spot - origins).astype(np.float32)
            distance = np.linalg.norm(towards, axis=1)
            towards /= distance[:, None]
            cosine = (towards * world.normals).sum(1)
            lit = np.flatnonzero(cosine > 0)
            rays = np.concatenate([origins[lit], towards[lit]], 1).astype(np.float32)
            blocked = self._tracer.test_occlusions(
                self._tensor(rays), tfar=float(distance.max()) * 0.98, nthreads=1
            )
            total[lit] += cosine[lit] * ~blocked.numpy()
        return total / samples

    def _sky_light(self, samples: int) -> Array:
        """(V,) cosine-weighted openness of each vertex, in [0, 1]."""
        world, rng = self._world, np.random.default_rng(6)
        total = np.zeros(len(world.vertices), np.float32)
        origins = self._origins
        for z, angle in zip((np.arange(samples) + 0.5) / samples, rng.permutation(samples), strict=True):
            turn = 2 * np.pi * (angle + 0.5) / samples
            r = np.sqrt(1 - z * z)
            # Normal plus a point of the unit sphere is cosine-distributed about the normal.
            sphere = np.array([r * np.cos(turn), r * np.sin(turn), 2 * rng.random() - 1], np.float32)
            sphere /= np.linalg.norm(sphere)
            directions = world.normals + 0.98 * sphere
            directions /= np.linalg.norm(directions, axis=1, keepdims=True)
            total += self._blocked(origins, directions, _OCCLUSION_REACH)
        return total / samples

    def picture(self, camera: Camera, oversample: int = 2) -> Picture:
        """A view of the room. `oversample`: rays per pixel and axis; labels come from the pixel's centre."""
        triangle, uv, _ = self._cast(camera.resized(camera.width * oversample, camera.height * oversample))
        seen = triangle >= 0
        linear = np.zeros((len(triangle), 3), np.float32)
        linear[seen] = self._shade(triangle[seen], uv[seen], camera.position)
        blocks = linear.reshape(camera.height, oversample, camera.width, oversample, 3).mean((1, 3))
        image = (to_display(_film(blocks)) * 255 + 0.5).astype(np.uint8)
        middle, _, depth = self._cast(camera)
        pieces = np.where(middle >= 0, self._world.piece_of[middle], -1).astype(np.int32)
        shape = (camera.height, camera.width)
        return Picture(image, pieces.reshape(shape), depth.reshape(shape))

    def _cast(self, camera: Camera) -> tuple[Array, Array, Array]:
        """First surface at pixel centres: (H*W,) triangle or -1, (H*W, 2) barycentrics, (H*W,) depth."""
        origin, directions = _rays(camera)
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin, directions
        hit = self._tracer.cast_rays(self._tensor(rays), nthreads=1)
        depth = hit["t_hit"].numpy()
        triangle = np.where(np.isfinite(depth), hit["primitive_ids"].numpy().astype(np.int64), -1)
        return triangle, hit["primitive_uvs"].numpy(), depth

    def colours_at(self, triangle: Array, uv: Array, eye: Array) -> Array:
        """(N, 3) uint8 colour of surface points, given by triangle and barycentrics, as seen from `eye`."""
        return (to_display(_film(self._shade(triangle, uv, eye))) * 255 + 0.5).astype(np.uint8)

    def _shade(self, triangle: Array, uv: Array, eye: Array) -> Array:
        """(N, 3) linear light leaving points towards `eye` (3,)."""
        world = self._world
        corners = world.triangles[triangle]
        weights = np.stack([1 - uv.sum(1), uv[:, 0], uv[:, 1]], 1).astype(np.float32)

        def blend(values: Array) -> Array:
            shape = (-1, 3) + (1,) * (values.ndim - 1)
            return (values[corners] * weights.reshape(shape)).sum(1)

        normal, sky, key, local = (blend(v) for v in (world.normals, self._sky, self._key, world.local))
        point = blend(world.vertices)
        albedo, gloss = self._albedo(world.piece_of[triangle], local)
        up = (0.5 + 0.5 * normal[:, 2:]).astype(np.float32)
        ambient = (up * _SKY + (1 - up) * np.array(_GROUND)) * sky[:, None] * self._light.sky
        lamp = self._light.key * np.array(_KEY)
        lit = albedo * (ambient + key[:, None] * lamp)
        half = _unit(_unit(self._light.position - point) + _unit(eye - point))
        shine = np.clip((half * normal).sum(1), 0, 1) ** 60 * gloss * np.sqrt(np.clip(key, 0, 1))
        return lit + 0.6 * shine[:, None] * lamp

    def _albedo(self, pieces: Array, local: Array) -> tuple[Array, Array]:
        """(N, 3) linear reflectance and (N,) gloss."""
        albedo, gloss = np.empty((len(pieces), 3), np.float32), np.empty(len(pieces), np.float32)
        order = np.argsort(pieces, kind="stable")
        borders = np.flatnonzero(np.diff(pieces[order])) + 1
        for rows in np.split(order, borders):
            material = self._world.materials[pieces[rows[0]]]
            albedo[rows] = to_linear(surface_colour(material, local[rows]))
            gloss[rows] = material.gloss
        return albedo, gloss


def _unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _film(linear: Array) -> Array:
    """A soft shoulder, so that highlights do not clip."""
    return np.where(linear < 0.7, linear, 0.7 + 0.3 * np.tanh((linear - 0.7) / 0.45))


def _rays(camera: Camera) -> tuple[Array, Array]:
    """Origin (3,) and (H*W, 3) directions through the pixel centres; length 1 along the camera's z axis."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    grid = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1).reshape(-1, 3)
    return camera.position, grid @ camera.rotation
