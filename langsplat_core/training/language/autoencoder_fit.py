"""The paper's codec: an autoencoder of one scene's CLIP vectors.

LangSplat section 3.2, with the layer widths of its public code (512-256-128-64-32-d with
batch normalisation and ReLU, latent normalised to length 1; decoder d-16-32-64-128-256-256-512 with
ReLU) and the paper's loss, L1 plus cosine distance.
"""

import numpy as np
import torch
from torch import nn

from langsplat_core.arrays import Array
from langsplat_core.config import CodecConfig
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import AutoencoderCodec

ENCODER_WIDTHS = (256, 128, 64, 32)
DECODER_WIDTHS = (16, 32, 64, 128, 256, 256)


def train_autoencoder(
    vectors: Array,
    latent_dim: int = 3,
    steps: int = CodecConfig.steps,
    batch: int = CodecConfig.batch,
    lr: float = CodecConfig.lr,
    seed: int = 0,
    progress: Progress = silent,
) -> AutoencoderCodec:
    """The autoencoder of (M, D) unit vectors: Adam with a cosine schedule on random batches; progress shows
    the batch's mean cosine. Deterministic for a given seed on one machine."""
    # Layers this small are slower on several threads than on one, and many times slower on a busy machine.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _train(vectors, latent_dim, (steps, batch, lr, seed), progress)
    finally:
        torch.set_num_threads(threads)


def _train(
    vectors: Array, latent_dim: int, settings: tuple[int, int, float, int], progress: Progress
) -> AutoencoderCodec:
    steps, size, lr, seed = settings
    torch.manual_seed(seed)
    data = torch.from_numpy(np.ascontiguousarray(vectors, np.float32))
    encoder, decoder = networks(data.shape[1], latent_dim)
    parameters = [*encoder.parameters(), *decoder.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=lr, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        batch = data[torch.randint(len(data), (size,), generator=generator)]
        latent = nn.functional.normalize(encoder(batch), dim=1, eps=1e-6)
        output = nn.functional.normalize(decoder(latent), dim=1, eps=1e-6)
        cosine = (output * batch).sum(1).mean()
        loss = nn.functional.l1_loss(output, batch) + (1 - cosine)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
        if step % 50 == 0 or step + 1 == steps:
            progress(f"codec: cosine {cosine.item():.3f}", (step + 1) / steps)
    _settle_statistics(encoder, data)
    return AutoencoderCodec(folded_layers(encoder), folded_layers(decoder))


def networks(dim: int, latent_dim: int) -> tuple[nn.Sequential, nn.Sequential]:
    encoder: list[nn.Module] = []
    width = dim
    for size in ENCODER_WIDTHS:
        encoder += [nn.Linear(width, size), nn.BatchNorm1d(size), nn.ReLU()]
        width = size
    encoder.append(nn.Linear(width, latent_dim))
    decoder: list[nn.Module] = []
    width = latent_dim
    for size in DECODER_WIDTHS:
        decoder += [nn.Linear(width, size), nn.ReLU()]
        width = size
    decoder.append(nn.Linear(width, dim))
    return nn.Sequential(*encoder), nn.Sequential(*decoder)


def _settle_statistics(encoder: nn.Sequential, data: torch.Tensor) -> None:
    """Recompute batch statistics over the data with final weights: running averages lag behind them,
    and with few vectors that lag is most of the reconstruction error."""
    for module in encoder:
        if isinstance(module, nn.BatchNorm1d):
            module.reset_running_stats()
            module.momentum = None  # cumulative average
    encoder.train()
    with torch.no_grad():
        for chunk in data.split(max(2, 8192)):
            if len(chunk) > 1:
                encoder(chunk)
    encoder.eval()


def folded_layers(network: nn.Sequential) -> tuple[tuple[Array, Array], ...]:
    """Weights as (out, in), bias pairs, with each batch normalisation folded into the layer before it."""
    layers: list[tuple[Array, Array]] = []
    for module in network:
        if isinstance(module, nn.Linear):
            weight, bias = module.weight.detach().double(), module.bias.detach().double()
            layers.append((weight.numpy(), bias.numpy()))
        elif isinstance(module, nn.BatchNorm1d):
            assert module.running_mean is not None
            assert module.running_var is not None
            scale = (module.weight / torch.sqrt(module.running_var + module.eps)).detach().double().numpy()
            shift = module.bias.detach().double().numpy() - module.running_mean.double().numpy() * scale
            last_weight, last_bias = layers[-1]
            layers[-1] = (last_weight * scale[:, None], last_bias * scale + shift)
    return tuple((w.astype(np.float32), b.astype(np.float32)) for w, b in layers)
