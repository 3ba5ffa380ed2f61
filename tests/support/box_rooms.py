"""A room of flat Gaussians whose planes are known: a floor, four walls, a table and blocks on it."""

import numpy as np
from scipy.spatial.transform import Rotation

from langsplat_core.arrays import Array
from langsplat_core.scene import Gaussians, Scene, look_at

FLOOR, WALL = -0.7, 2.0  # height of the floor; distance of the walls from the middle
STEP = 0.1


def _sheet(centre: Array, first: Array, second: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points over the rectangle centre +- first +- second, jittered in it, and their normals."""
    counts = [max(round(2 * float(np.linalg.norm(side)) / STEP), 1) for side in (first, second)]
    u, v = np.meshgrid(*(np.linspace(-1, 1, count) for count in counts))
    uv = np.stack([u.ravel(), v.ravel()], 1) + rng.uniform(-0.3, 0.3, (u.size, 2)) / counts
    normal = np.cross(first, second) / np.linalg.norm(np.cross(first, second))
    return centre + uv @ np.stack([first, second]), np.tile(normal, (u.size, 1))


def box_room(seed: int = 0) -> Scene:
    """The room of a seed, which decides what stands on the table; z is up."""
    rng = np.random.default_rng(seed)
    x, y, z = np.eye(3)
    parts = [_sheet(FLOOR * z, WALL * x, WALL * y, rng)]
    for side in (x, -x, y, -y):
        across = np.cross(z, side)
        parts.append(_sheet(WALL * side + (FLOOR + 0.7) * z, WALL * across, 0.7 * z, rng))
    blocks = [(np.zeros(3), np.array([0.8, 0.5, 0.03]))]
    for _ in range(7):
        half = rng.uniform(0.06, 0.25, 3)
        blocks.append((np.array([*rng.uniform(-0.6, 0.6, 1), *rng.uniform(-0.35, 0.35, 1), half[2]]), half))
    blocks += [(np.array([1.5, rng.uniform(-1, 1), FLOOR + 0.3]), np.array([0.3, 0.4, 0.3]))]
    for centre, half in blocks:
        for axis in range(3):
            first, second = np.diag(half)[[(axis + 1) % 3, (axis + 2) % 3]]
            for sign in (-1, 1):
                offset = np.zeros(3)
                offset[axis] = sign * half[axis]
                parts.append(_sheet(centre + offset, first, second, rng))
    points, normals = (np.concatenate(column) for column in zip(*parts, strict=True))
    turns = [
        Rotation.align_vectors([normal], [[0, 0, 1]])[0].as_quat() for normal in np.unique(normals, axis=0)
    ]
    which = np.unique(normals, axis=0, return_inverse=True)[1].reshape(-1)
    gaussians = Gaussians(
        means=points,
        log_scales=np.tile(np.log([STEP, STEP, 0.003]), (len(points), 1)),
        quats_wxyz=np.array(turns)[which][:, [3, 0, 1, 2]],
        opacity_logits=np.full(len(points), 4.0),
        sh=rng.normal(size=(len(points), 1, 3)),
    )
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    eyes = [np.array([1.4 * np.cos(a), 1.4 * np.sin(a), 0.5]) for a in angles]
    return Scene(gaussians, cameras=tuple(look_at(eye, FLOOR / 2 * z, z, (96, 72), 70) for eye in eyes))
