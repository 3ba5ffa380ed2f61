"""Similarity transforms (move, rotate, scale) of a scene: its Gaussians, spherical harmonics and cameras."""

import math
from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array, across, affine, pieces, quaternions, unit
from langsplat_core.errors import InputError
from langsplat_core.scene.gaussians import SH_COUNTS, Gaussians
from langsplat_core.scene.scene import FARTHEST, Camera, Scene, origin_of

SHEAR = 1e-4  # largest difference of a matrix, divided by its scale, from a rotation
AXES = {name: np.eye(3)[place] for place, name in enumerate("xyz")}
AXES |= {f"-{name}": -axis for name, axis in AXES.items()}


@dataclass(frozen=True, eq=False)
class Similarity:
    """The map x -> scale * rotation @ x + translation."""

    rotation: Array  # (3, 3) float64, orthogonal with determinant 1
    translation: Array  # (3,) float64 world units
    scale: float = 1.0  # > 0 and finite

    def __post_init__(self) -> None:
        if not (0 < self.scale < math.inf):
            raise InputError(f"a scale of {self.scale:g} leaves no scene; give a finite number above 0")
        if not (np.isfinite(self.rotation).all() and np.isfinite(self.translation).all()):
            raise InputError("a transform of numbers that are not finite; mend the move or the matrix")

    @property
    def matrix(self) -> Array:
        """The (4, 4) float64 homogeneous matrix of the map."""
        return affine(self.scale * self.rotation, self.translation)

    @property
    def is_identity(self) -> bool:
        """True where the map leaves every point where it is."""
        return bool((self.matrix == np.eye(4)).all())

    def points(self, points: Array) -> Array:
        """Return where the map takes (..., 3) points, float64."""
        with np.errstate(invalid="ignore", over="ignore"):
            moved: Array = np.asarray(points, np.float64) @ (self.scale * self.rotation.T) + self.translation
        return moved

    def then(self, other: "Similarity") -> "Similarity":
        """Return this map followed by `other`."""
        shift = other.points(self.translation)
        return Similarity(other.rotation @ self.rotation, shift, self.scale * other.scale)

    def inverse(self) -> "Similarity":
        """Return the inverse map."""
        return Similarity(self.rotation.T, -self.rotation.T @ self.translation / self.scale, 1 / self.scale)

    def about(self, centre: Array) -> "Similarity":
        """Return the same rotation and scale with `centre` (3,) in place of the origin."""
        return moving(-np.asarray(centre)).then(self).then(moving(centre))

    def quaternions(self, quats_wxyz: Array) -> Array:
        """Return (N, 4) float64 quaternions followed by this rotation; lengths are kept, zero stays zero."""
        w, x, y, z = quaternions(self.rotation)
        left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
        with np.errstate(invalid="ignore"):
            return np.asarray(np.asarray(quats_wxyz, np.float64) @ left.T)

    def camera(self, camera: Camera) -> Camera:
        """Return `camera` moved along with the world; InputError where it would lie too far out."""
        position = self.points(camera.position)
        if np.abs(position).max() > FARTHEST:
            raise InputError(f"a camera would lie more than {FARTHEST:g} units from the origin; move by less")
        rotation = camera.rotation @ self.rotation.T
        pose = affine(rotation, -rotation @ position)
        zoom = 1 / self.scale if camera.orthographic else 1.0  # whose focal lengths are pixels per unit
        return replace(camera, world_to_camera=pose, fx=camera.fx * zoom, fy=camera.fy * zoom)


IDENTITY = Similarity(np.eye(3), np.zeros(3))


def moving(offset: Array) -> Similarity:
    """Return the move by `offset` (3,), world units."""
    return Similarity(np.eye(3), np.asarray(offset, np.float64))


def scaling(factor: float) -> Similarity:
    """Return the scaling by `factor` about the origin. InputError beyond 1e-12 to 1e12."""
    if not 1e-12 <= factor <= 1e12:
        raise InputError(f"a scale of {factor:g}; take 1e-12 to 1e12")
    return Similarity(np.eye(3), np.zeros(3), float(factor))


def rotating(axis: Array, degrees: float) -> Similarity:
    """Return the right-handed rotation about `axis` (3,) through the origin, exact for quarter turns."""
    if not (np.isfinite(axis).all() and np.linalg.norm(axis) > 1e-12 and math.isfinite(degrees)):
        raise InputError("a rotation about no direction; give an axis that is not zero and finite degrees")
    x, y, z = unit(np.asarray(axis, np.float64), 1e-300)
    cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    if degrees % 90 == 0:
        cosine, sine = round(cosine), round(sine)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + sine * cross + (1 - cosine) * cross @ cross  # Rodrigues
    return Similarity(rotation, np.zeros(3))


def turning(direction: Array, onto: Array) -> Similarity:
    """Return the smallest rotation that turns `direction` (3,) onto the direction `onto` (3,)."""
    a, b = unit(np.asarray(direction, np.float64), 1e-300), unit(np.asarray(onto, np.float64), 1e-300)
    axis, cosine = np.cross(a, b), float(a @ b)
    if np.linalg.norm(axis) < 1e-9:  # the same, or opposite: any axis across
        return IDENTITY if cosine > 0 else rotating(across(a), 180)
    return rotating(axis, math.degrees(math.atan2(float(np.linalg.norm(axis)), cosine)))


def similarity(matrix: Array) -> Similarity:
    """Return the similarity of a matrix; InputError: mirrored, flat, sheared, projective or not finite."""
    matrix = np.asarray(matrix, np.float64)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError("a transform is a matrix of 4 x 4 numbers, or 3 x 4")
    linear = matrix[:3, :3]
    if not np.isfinite(matrix).all():
        raise InputError("a matrix whose numbers are not all finite is no transform")
    if matrix.shape[0] == 4 and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        raise InputError("the last row of a transform's matrix must be 0 0 0 1")
    with np.errstate(over="ignore"):
        determinant = float(np.linalg.det(linear))
    if not np.isfinite(determinant):
        raise InputError("the matrix makes the scene larger than numbers can say")
    if determinant < 0:
        raise InputError("the matrix mirrors the scene, which Gaussians cannot follow; negate one axis of it")
    if (scale := determinant ** (1 / 3)) <= 1e-12:
        raise InputError("the matrix makes the scene flat; its scale must be above 0")
    left, _, right = np.linalg.svd(linear / scale)
    rotation = left @ right
    if np.abs(linear / scale - rotation).max() > SHEAR:
        raise InputError("the matrix shears the scene or scales its axes unlike; give one scale for all axes")
    return Similarity(rotation, matrix[:3, 3].copy(), scale)


def turned_origin(rotation: Array, origin: Array) -> Array:
    """Return the `origin` (3,) of a scene after the `rotation` (3, 3) that stands the scene upright.

    A rotation within 0.1 of one that maps axes onto axes is replaced by it: estimates from a floor or from
    cameras are slightly aslant, and such a rotation about zero would move a far scene by metres.
    """
    near = np.rint(rotation)
    return np.asarray((near if np.abs(rotation - near).max() < 0.1 else rotation) @ origin)


def transform_gaussians(gaussians: Gaussians, to: Similarity) -> Gaussians:
    """Return the transformed Gaussians. InputError where valid ones would leave what float32 holds."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = Gaussians(
            to.points(gaussians.means).astype(np.float32),
            (gaussians.log_scales + math.log(to.scale)).astype(np.float32),
            to.quaternions(gaussians.quats_wxyz).astype(np.float32),
            gaussians.opacity_logits,
            rotated_harmonics(gaussians.sh, to.rotation),
        )
    if lost := int((gaussians.valid() & ~moved.valid()).sum()):
        raise InputError(f"{lost} Gaussians would lie or reach beyond what float32 holds; move by less")
    return moved


def transform_scene(scene: Scene, to: Similarity, selected: Array | None = None) -> Scene:
    """Return the scene, cameras and metres per unit transformed, or only the `selected` (N,) Gaussians."""
    if to.is_identity:
        return scene
    if selected is not None:
        part = transform_gaussians(scene.gaussians.take(selected), to)
        names = ("means", "log_scales", "quats_wxyz", "sh")
        arrays = {name: getattr(scene.gaussians, name).copy() for name in names}
        for name, values in arrays.items():
            values[selected] = getattr(part, name)
        return replace(scene, gaussians=replace(scene.gaussians, **arrays))
    metres = scene.metres_per_unit
    return replace(
        scene,
        gaussians=transform_gaussians(scene.gaussians, to),
        cameras=tuple(to.camera(camera) for camera in scene.cameras),
        metres_per_unit=None if metres is None else metres / to.scale,
    )


def between_worlds(to: Similarity, origin: Array, target: Array) -> Similarity:
    """Return `to`, a map from a scene with `origin` (3,) to one with origin `target`, as one of the world."""
    return moving(-origin).then(to).then(moving(target))


def place_scene(scene: Scene, to: Similarity = IDENTITY, origin: Array | None = None) -> Scene:
    """Return the scene moved by `to`, a map of the world; relative to `origin` (3,), else `origin_of` it."""
    centre, radius = scene.bounds()
    if origin is None:
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        origin = origin_of(to.points(scene.in_world(centre + radius * axes)))
    return replace(transform_scene(scene, between_worlds(to, -scene.origin, -origin)), origin=origin)


# View-dependent colour: real spherical harmonics up to degree 3, as 3D Gaussian Splatting uses them.

BLOCK = 1 << 18  # Gaussians whose harmonics are rotated at a time, in float64: 100 MB
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi))
C1 = 0.4886025119029199  # sqrt(3 / (4 pi))
C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)


def sh_basis(directions: Array, count: int) -> Array:
    """Return (N, count) basis values at unit directions from the camera to the Gaussians."""
    x, y, z = np.moveaxis(directions, -1, 0)
    values = [
        np.full_like(x, C0),
        -C1 * y,
        C1 * z,
        -C1 * x,
        C2[0] * x * y,
        -C2[0] * y * z,
        C2[1] * (2 * z * z - x * x - y * y),
        -C2[0] * x * z,
        C2[2] * (x * x - y * y),
        -C3[0] * y * (3 * x * x - y * y),
        C3[1] * x * y * z,
        -C3[2] * y * (4 * z * z - x * x - y * y),
        C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -C3[2] * x * (4 * z * z - x * x - y * y),
        C3[4] * z * (x * x - y * y),
        -C3[0] * x * (x * x - 3 * y * y),
    ]
    return np.stack(values[:count], -1)


def sh_rotations(rotation: Array, degree: int) -> list[Array]:
    """Return the (2l + 1, 2l + 1) float64 matrix that rotates the coefficients of each degree l <= `degree`.

    The rotated function is f'(d) = f(R^T d), and each degree is closed under rotations, so that its matrix
    solves B(d) M = B(R^T d) for directions d that determine it (Wigner's matrices of the real basis).
    """
    index = np.arange(64) + 0.5  # a spiral of directions, even on the sphere
    z, turn = 1 - 2 * index / 64, np.pi * (1 + 5**0.5) * index
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    before, after = (sh_basis(d, SH_COUNTS[degree]) for d in (directions @ rotation, directions))
    spans = [slice(order**2, (order + 1) ** 2) for order in range(degree + 1)]
    return [np.linalg.lstsq(after[:, span], before[:, span], rcond=None)[0] for span in spans]


def rotated_harmonics(sh: Array, rotation: Array) -> Array:
    """Return (N, K, 3) float32 coefficients of the same colours seen from rotated directions."""
    degree = math.isqrt(sh.shape[1]) - 1
    if degree == 0 or (rotation == np.eye(3)).all():
        return sh
    turned = sh.copy()
    for order, matrix in enumerate(sh_rotations(rotation, degree)[1:], 1):
        span = slice(order**2, (order + 1) ** 2)
        for part in pieces(len(sh), BLOCK):
            by_channel = sh[part, span].swapaxes(1, 2).astype(np.float64)
            turned[part, span] = (by_channel @ matrix.T).swapaxes(1, 2)
    return turned
