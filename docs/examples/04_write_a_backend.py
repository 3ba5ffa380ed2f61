"""A rasterizer of one's own, discs in place of Gaussians: what the protocol asks for, and its error."""

from importlib.resources import files

import numpy as np

from langsplat_core import load_rasterizer, load_scene, view_of
from langsplat_core.raster import View
from langsplat_core.raster.protocol import dilation


class DiscView(View):
    def __init__(self, gaussians, camera, settings):
        centres, self.depths = camera.project(gaussians.means)  # pixels, world units
        variances = (np.exp(gaussians.log_scales).mean(1) * camera.fx / self.depths) ** 2
        variances += dilation(camera, settings).added
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), -1) + 0.5
        squared = ((pixels - centres[:, None, None]) ** 2).sum(-1) / variances[:, None, None]  # (N, H, W)
        opacities = (self.depths > settings.near) / (1 + np.exp(-gaussians.opacity_logits))
        self.camera, self.count, self.dropped = camera, len(gaussians), 0  # rows that cannot be drawn
        order = np.argsort(self.depths)  # front to back
        alphas = np.minimum(opacities[:, None, None] * np.exp(-0.5 * squared), settings.alpha_max)[order]
        light = np.cumprod(1 - alphas, 0) / (1 - alphas)  # that reaches each
        self.weights = (alphas * light)[np.argsort(order)]  # the matrix W of `langsplat_core.raster.protocol`

    def splat(self, values):  # (N, C) -> W x, (H, W, C), and alpha; a view that can lift has `gather`, W^T y
        return np.einsum("nhw,nc->hwc", self.weights, values), self.weights.sum(0)


class Discs:
    name, view = "discs", staticmethod(DiscView)


scene = load_scene(str(files("langsplat_assets") / "demo" / "scene.ply"))
few, camera = scene.take(slice(None, None, 32)), scene.cameras[3].resized(80, 60)
truth, _ = view_of(few, camera, load_rasterizer("reference")).splat(few.gaussians.sh[:, 0])
for rasterizer in (Discs(), load_rasterizer("cpu")):
    error = np.abs(view_of(few, camera, rasterizer).splat(few.gaussians.sh[:, 0])[0] - truth)
    print(f"{rasterizer.name}: mean error {error.mean():.1e}, largest {error.max():.1e}")
