"""Small files of other methods in their own layouts, written apart from the code under test."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from langsplat_core.arrays import Array
from langsplat_core.scene import Gaussians


def geometry(g: Gaussians) -> list[Any]:
    """Elements 0 to 6 of a model: parameters on the CPU, as a checkpoint made there holds them."""
    arrays = (g.means, g.sh[:, :1], g.sh[:, 1:], g.log_scales, g.quats_wxyz, g.opacity_logits[:, None])
    return [3, *(nn.Parameter(torch.tensor(np.ascontiguousarray(array))) for array in arrays)]


def training_state(g: Gaussians) -> list[Any]:
    """What ends every tuple: radii, gradients and their counts, optimiser, extent (a NumPy number)."""
    n = len(g)
    xyz = nn.Parameter(torch.zeros(n, 3))
    optimiser = torch.optim.Adam([xyz], lr=0.0025, eps=1e-15)
    xyz.grad = torch.ones_like(xyz)
    optimiser.step()
    sums = [torch.zeros(n), torch.zeros(n, 1), torch.zeros(n, 1)]
    return [*sums, optimiser.state_dict(), np.float64(4.25)]


def save_model(path: Path, g: Gaussians, *between: Any, behind: tuple[Any, ...] = ()) -> Path:
    """(tuple, iteration) with `between` geometry and training state, and `behind` it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    torch.save(((*geometry(g), *between, *training_state(g), *behind), 30_000), path)
    return path


def tensor(array: Array) -> nn.Parameter:
    return nn.Parameter(torch.from_numpy(np.array(array)), requires_grad=array.dtype.kind == "f")


class LangSplatAutoencoder(nn.Module):
    """The network whose `state_dict` is `best_ckpt.pth`."""

    def __init__(self, dim: int, encoder: tuple[int, ...], decoder: tuple[int, ...]) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for number, (into, out) in enumerate(zip((dim, *encoder), encoder, strict=False)):
            layers += [nn.BatchNorm1d(into), nn.ReLU()] if number else []
            layers.append(nn.Linear(into, out))
        self.encoder = nn.ModuleList(layers)
        layers = []
        for number, (into, out) in enumerate(zip((encoder[-1], *decoder), (*decoder, dim), strict=True)):
            layers += [nn.ReLU()] if number else []
            layers.append(nn.Linear(into, out))
        self.decoder = nn.ModuleList(layers)

    def encode(self, x: torch.Tensor) -> torch.Tensor:
        for layer in self.encoder:
            x = layer(x)
        return x / x.norm(dim=-1, keepdim=True)

    def decode(self, x: torch.Tensor) -> torch.Tensor:
        for layer in self.decoder:
            x = layer(x)
        return x / x.norm(dim=-1, keepdim=True)


def autoencoder(
    dim: int,
    encoder: tuple[int, ...] = (256, 128, 64, 32, 3),
    decoder: tuple[int, ...] = (16, 32, 64, 128, 256, 256),
) -> LangSplatAutoencoder:
    """In evaluation, with statistics and scales of batch normalisation that are not the initial ones."""
    torch.manual_seed(1)
    network = LangSplatAutoencoder(dim, encoder, decoder)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.uniform_(module.weight, 0.5, 2)
            nn.init.uniform_(module.bias, -0.3, 0.3)
    for _ in range(20):
        x = torch.randn(64, dim)
        for layer in network.encoder:
            x = layer(x)
    return network.eval()


def faiss_index(centroids: Array, kind: bytes = b"IxPq", metric: int = 1, bits: int = 8) -> bytes:
    """An IndexPQ as faiss writes it, with three vectors in it."""
    parts, _, part_dim = centroids.shape
    dim = parts * part_dim
    out = kind + struct.pack("<iqqq?i", dim, 3, 1 << 20, 1 << 20, True, metric)
    out += struct.pack("<f", 0.5) if metric > 1 else b""
    out += struct.pack("<QQQQ", dim, parts, bits, centroids.size) + centroids.astype("<f4").tobytes()
    return out + struct.pack("<Q", 3 * parts) + bytes(3 * parts) + struct.pack("<i?i", 0, False, 0)
