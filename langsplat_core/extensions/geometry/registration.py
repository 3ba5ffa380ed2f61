"""The transform between two scenes of one place, and whether it can be trusted.

Features of surface points are matched by RANSAC and refined by ICP (Open3D); renderings check the answer.
"""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.extensions.geometry.points import cloud, sample_surface
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.render import view_of
from langsplat_core.scene import Camera, Scene
from langsplat_core.scene.transform import similarity

SAMPLES = 40_000  # points of each surface
ROUGH, FINE = 0.06, 0.03  # of the fixed scene's radius: spacing of points for features, and for ICP
TRIES = 50_000  # of RANSAC
AGAIN = 2  # times RANSAC is begun
SIZES = (1.0, 0.8, 1.25)  # times the ratio of the scenes' radii: where it begins if the scale is open
VIEWS, SIDE = 8, 120  # cameras of either scene that check it, and pixels of their longer side
ALIKE = 0.05  # of the depth: surfaces that are no farther apart are the same
TRUSTED = 0.7  # of the pixels that both scenes fill, from which two scenes are one place
OVERLAP = 0.2  # of an image that both scenes fill, below which a camera says nothing

STAGE = "registering"


@dataclass(frozen=True, eq=False)
class Registration:
    """The pose and size of a scene in the axes of another."""

    transform: Array  # (4, 4) float64 similarity, from the moving scene to the fixed one
    rmse: float  # of points that lie on each other, units of the fixed scene
    agreement: float  # of the pixels that both fill as seen by their cameras, the share of the same depth

    @property
    def scale(self) -> float:
        """Length of one unit of the moving scene, in units of the fixed one."""
        return float(np.cbrt(np.linalg.det(self.transform[:3, :3])))

    @property
    def trusted(self) -> bool:
        """True if the two scenes show one place, as far as renderings tell."""
        return self.agreement >= TRUSTED


def register(
    moving: Scene, fixed: Scene, scaled: bool = False, seed: int = 0, progress: Progress = silent
) -> Registration:
    """Find the rigid motion, and with `scaled` the change of scale, that lays one scene onto another.

    Without `scaled` units are the same, up to what the two scenes say of metres. Raises InputError for a
    scene without a surface. What is found is no more than a proposal unless it is `trusted`.
    """
    unit = 1.0
    if moving.metres_per_unit is not None and fixed.metres_per_unit is not None:
        unit, scaled = moving.metres_per_unit / fixed.metres_per_unit, False
    elif scaled:
        unit = fixed.bounds()[1] / moving.bounds()[1]
    turns = quarter_turns(fixed)
    radius = fixed.bounds()[1]
    mine, theirs = (sample_surface(scene.gaussians, SAMPLES, seed)[0] for scene in (moving, fixed))
    best: Registration | None = None
    sizes = [unit * factor for factor in SIZES] if scaled else [unit] * AGAIN
    for start, size in enumerate(sizes):
        progress(STAGE, start / len(sizes))
        matrix, rmse = _aligned(size * mine, theirs, turns, radius, scaled, seed + start)
        found = Registration(matrix @ np.diag([size, size, size, 1.0]), rmse, 0.0)
        found = replace(found, agreement=agreement(moving, fixed, found.transform))
        if best is None or found.agreement > best.agreement:
            best = found
        if best.trusted:
            break
    progress(STAGE, 1.0)
    assert best is not None
    return best


def quarter_turns(scene: Scene) -> list[Array]:
    """Four (4, 4) rotations about up through the middle of a scene: rooms are nearly alike from all sides."""
    centre, up = scene.bounds()[0], scene.up()
    cross = np.cross(np.eye(3), up).T  # cross @ x = up x x
    made = []
    for quarter in range(4):
        sine, cosine = np.sin(np.pi / 2 * quarter), np.cos(np.pi / 2 * quarter)
        turn = np.eye(4)
        turn[:3, :3] += sine * cross + (1 - cosine) * cross @ cross
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        made.append(turn)
    return made


def _aligned(
    moving: Array, fixed: Array, turns: list[Array], radius: float, scaled: bool, seed: int
) -> tuple[Array, float]:
    """(4, 4) that lays points (P, 3) onto others, and the error of those that lie on each other.

    turns: (4, 4) each, tried after RANSAC.
    """
    import open3d

    methods = open3d.pipelines.registration
    open3d.utility.random.seed(seed)
    voxel = ROUGH * radius
    near = open3d.geometry.KDTreeSearchParamHybrid(radius=2.5 * voxel, max_nn=30)
    wide = open3d.geometry.KDTreeSearchParamHybrid(radius=5 * voxel, max_nn=100)
    clouds = [cloud(points).voxel_down_sample(voxel) for points in (moving, fixed)]
    for one in clouds:
        one.estimate_normals(near)
    features = [methods.compute_fpfh_feature(one, wide) for one in clouds]
    estimate = methods.TransformationEstimationPointToPoint()
    checks = [
        methods.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        methods.CorrespondenceCheckerBasedOnDistance(1.5 * voxel),
    ]
    until = methods.RANSACConvergenceCriteria(TRIES, 0.999)
    rough = methods.registration_ransac_based_on_feature_matching(
        *clouds, *features, True, 1.5 * voxel, estimate, 3, checks, until
    )
    voxel = FINE * radius
    clouds = [cloud(points).voxel_down_sample(voxel) for points in (moving, fixed)]
    estimate = methods.TransformationEstimationPointToPoint(True)
    if not scaled:
        estimate = methods.TransformationEstimationPointToPlane()
        clouds[1].estimate_normals(near)
    found = []
    for turn in turns:
        matrix = turn @ rough.transformation
        for reach in (3.0, 1.0):
            result = methods.registration_icp(*clouds, reach * voxel, matrix, estimate)
            matrix = result.transformation
        found.append((float(result.inlier_rmse) / max(float(result.fitness), 1e-9), result))
    best = min(found, key=lambda one: one[0])[1]
    return np.asarray(best.transformation, np.float64), float(best.inlier_rmse)


def agreement(moving: Scene, fixed: Scene, transform: Array) -> float:
    """Return the share of pixels at which two scenes have surfaces at the same depth.

    It is of the pixels that both fill, as seen by cameras of both; 0 where no camera sees enough of both.
    transform: (4, 4), moving to fixed.
    """
    there = similarity(transform)
    views = [(camera, there.inverse().camera(camera)) for camera in _some(fixed)]
    views += [(there.camera(camera), camera) for camera in _some(moving)]
    same = both = 0
    for in_fixed, in_moving in views:
        near, far = (_depths(scene, view) for scene, view in ((fixed, in_fixed), (moving, in_moving)))
        filled = (near > 0) & (far > 0)
        if filled.mean() >= OVERLAP:
            both += int(filled.sum())
            same += int((np.abs(there.scale * far - near) <= ALIKE * near)[filled].sum())
    return same / both if both else 0.0


def _some(scene: Scene) -> list[Camera]:
    """Return a few cameras of a scene, small; two that frame it where it has none."""
    cameras = scene.cameras or (scene.framing_camera((SIDE, SIDE)),)
    chosen = np.unique(np.linspace(0, len(cameras) - 1, VIEWS).astype(int))
    shrink = [SIDE / max(cameras[i].width, cameras[i].height) for i in chosen]
    return [
        cameras[i].resized(max(round(s * cameras[i].width), 1), max(round(s * cameras[i].height), 1))
        for i, s in zip(chosen, shrink, strict=True)
    ]


def _depths(scene: Scene, camera: Camera) -> Array:
    """(H, W) depth of half transmittance, 0 where there is none."""
    return view_of(scene, camera).median_depth().astype(np.float64)
