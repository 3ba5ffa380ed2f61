"""Stages of OpenUSD, as usd-core reads and judges them."""

import numpy as np
import pytest

from langsplat_core.arrays import rotation_matrices
from langsplat_core.cli.app import parse
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene.transform import moving, place_scene
from tests.support.scenes import DEMO

pxr = pytest.importorskip("pxr", reason="no usd-core here: pip install usd-core")


@pytest.mark.parametrize("suffix", [".usda", ".usdc"])
def test_stage_is_valid_and_stands_upright_in_metres(tmp_path, capsys, suffix):
    from pxr import Usd, UsdGeom, UsdValidation

    scene = load_scene(DEMO).take(np.arange(0, 80_000, 40))
    at = np.array([500_123.25, 5_412_345.5, 30.0])  # UTM
    save_scene(tmp_path / "far.ply", place_scene(scene, moving(at)))
    out = tmp_path / f"far{suffix}"
    parse(["usd", str(tmp_path / "far.ply"), str(out)]).run()
    assert "2,000 Gaussians, and the numbers of its things" in capsys.readouterr().out
    stage = Usd.Stage.Open(str(out))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []
    prim = stage.GetDefaultPrim()
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"

    def get(name: str) -> np.ndarray:
        return np.array(prim.GetAttribute(name).Get())

    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0))
    world = get("positions") @ matrix[:3, :3] + matrix[3, :3]
    given = load_scene(tmp_path / "far.ply")
    heights = given.in_world(given.gaussians.means) @ given.up()
    np.testing.assert_allclose(np.diff(world[:, 1]), np.diff(heights), atol=1e-6)
    np.testing.assert_allclose(np.exp(given.gaussians.log_scales), get("scales"), rtol=1e-6)
    quats = get("orientations")[:, [3, 0, 1, 2]]  # i, j, k, r in memory
    axes = np.swapaxes(rotation_matrices(quats), 1, 2) @ matrix[:3, :3]
    upright = (
        np.abs(axes[..., 1]),
        np.abs(np.swapaxes(rotation_matrices(given.gaussians.quats_wxyz), 1, 2) @ given.up()),
    )
    np.testing.assert_allclose(*upright, atol=1e-5)
    assert get("radiance:sphericalHarmonicsCoefficients").shape == (2000 * given.gaussians.sh.shape[1], 3)
    np.testing.assert_array_equal(get("primvars:whole"), given.language.tree.at(2))
