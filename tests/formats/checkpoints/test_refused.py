"""Files of other methods that are refused: one line each, which names the file."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch

from langsplat_core.arrays import unit
from langsplat_core.errors import InputError
from langsplat_core.io.foreign import read_foreign
from langsplat_core.scene import Gaussians
from tests.support.foreign_files import (
    autoencoder,
    faiss_index,
    geometry,
    save_model,
    tensor,
    training_state,
)
from tests.support.scenes import random_gaussians

N, D = 20, 24
G = random_gaussians(N, sh_degree=3)
rng = np.random.default_rng(3)
VECTORS = rng.normal(size=(3, N, D)).astype(np.float32)
LATENTS = unit(rng.normal(size=(3, N, 3))).astype(np.float32)
CENTROIDS = rng.normal(size=(4, 256, D // 4)).astype(np.float32)
ALL = np.arange(N)


def langsplat(folder: Path, levels: tuple[int, ...] = (1, 2, 3), g: Gaussians = G) -> list[Path]:
    return [
        save_model(folder / f"teatime_{level}" / "chkpnt30000.pth", g, tensor(LATENTS[level - 1]))
        for level in levels
    ]


def best_ckpt(folder: Path, **widths: tuple[int, ...]) -> Path:
    torch.save(autoencoder(D, **widths).state_dict(), folder / "best_ckpt.pth")
    return folder / "best_ckpt.pth"


class Harmful:
    """Would run a command when unpickled."""

    def __reduce__(self):
        return (os.system, ("exit 1",))


def read_whole(paths: list[Path]) -> None:
    scene = read_foreign(paths)
    for level in range(3):
        if scene.levels[level] is not None:
            scene.rows(level, ALL)


def refused(paths: list[Path], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_whole(paths)
    assert "\n" not in str(caught.value)
    assert any(str(caught.value).startswith(str(path)) for path in paths)


def test_classes_are_not_unpickled(tmp_path):
    path = save_model(tmp_path / "c.pth", G, behind=(Harmful(),))
    refused([path], r"needs '(posix|nt).system'; only tensors")
    path.write_bytes(pickle.dumps(Harmful()))
    refused([path], r"needs 'posix.system'|not a whole file")


def wrong(index: int, value: object) -> tuple[object, ...]:
    elements = [*geometry(G), tensor(VECTORS[0]), *training_state(G)]
    elements[index] = value
    return tuple(elements)


@pytest.mark.parametrize(
    ("index", "value", "message"),
    [
        (1, torch.zeros(N, 2), r"element 1 has the shape \(20, 2\); expected positions"),
        (1, None, "element 1 holds no positions"),
        (3, torch.zeros(N, 7, 3), "7 SH coefficients"),
        (4, torch.zeros(N, 2), r"element 4 has the shape \(20, 2\); expected log scales"),
        (5, torch.zeros(N + 1, 4), r"expected rotations \(20, 4\)"),
        (6, torch.zeros(N, 1, dtype=torch.int64), "element 6 holds no opacities"),
        (7, torch.zeros(N + 1, D), r"features \(21, 24\) for 20 Gaussians"),
        (7, torch.zeros(N, D, dtype=torch.int32), "features of the type int32"),
        (7, torch.zeros(1).expand(10**9, 24), "more numbers than the file has"),
        (7, torch.zeros(N, D, dtype=torch.complex64), "needs 'torch.ComplexFloatStorage'"),
        (7, torch.full((N, D), torch.nan), "features are not finite, as those of Gaussian 0"),
    ],
)
def test_wrong_elements(tmp_path, index, value, message):
    torch.save((wrong(index, value), 1), tmp_path / "c.pth")
    refused([tmp_path / "c.pth"], message)


def test_files_that_do_not_go_together(tmp_path):
    ae, levels = best_ckpt(tmp_path), langsplat(tmp_path)
    refused(levels, "3 numbers per Gaussian, latents of LangSplat's autoencoder; name its best_ckpt.pth")
    refused([ae], "belongs to checkpoints with features")
    plain = save_model(tmp_path / "plain.pth", G)
    refused([ae, plain], "belongs to checkpoints with features")
    refused([plain, plain], "two scenes without features")
    refused([ae, ae, *levels], "two autoencoders")
    moved = langsplat(tmp_path / "other", (2,), random_gaussians(N, seed=1, sh_degree=3))
    refused([levels[0], *moved, ae], "its 20 Gaussians are not the 20 of the other files")
    fewer = save_model(tmp_path / "f_2.pth", G.take(ALL[1:]), tensor(LATENTS[1][1:]))
    refused([levels[0], fewer, ae], "its 19 Gaussians are not the 20")
    apart = save_model(tmp_path / "f_3.pth", random_gaussians(N, 1, 3), tensor(VECTORS[1]))
    whole = save_model(tmp_path / "g_1.pth", G, tensor(VECTORS[0]))
    refused([whole, apart], "0 of 20 Gaussians are at positions of the other files'")
    refused([whole, levels[1], ae], "give the files of one method")
    refused([*levels, levels[0], ae], "a fourth checkpoint")
    d4 = save_model(tmp_path / "d4.pth", G, tensor(VECTORS[0][:, :4]))
    refused([d4, ae], "4 numbers per Gaussian, but .* makes 3")


def test_damaged_autoencoders(tmp_path):
    good, checkpoint = autoencoder(D).state_dict(), langsplat(tmp_path, (1,))[0]
    missing = {name: value for name, value in good.items() if name != "encoder.3.bias"}
    infinite = good | {"decoder.4.bias": good["decoder.4.bias"] * torch.nan}
    short = good | {"decoder.0.weight": torch.zeros(16, 4)}
    for state, message in (
        (missing, "not an autoencoder of LangSplat's kind"),
        (short, "not an autoencoder of LangSplat's kind"),
        (infinite, "weights are not finite"),
        ({"layer.weight": torch.zeros(3, 3)}, "not a checkpoint or autoencoder of a known method"),
    ):
        torch.save(state, tmp_path / "ae.pth")
        refused([tmp_path / "ae.pth", checkpoint], message)


def test_damaged_quantisers(tmp_path):
    path, checkpoint = tmp_path / "pq", save_model(tmp_path / "c.pth", G, tensor(np.zeros((N, 4), np.uint8)))
    good = faiss_index(CENTROIDS)
    for content, message in (
        (faiss_index(CENTROIDS, b"IwPQ"), "of the kind 'IwPQ'"),
        (faiss_index(CENTROIDS, bits=4), "parts of 4 bits"),
        (good[:2000], "truncated: 6144 centroid numbers"),
        (good[:40], "ends in its header"),
        (faiss_index(CENTROIDS * np.nan), "not finite"),
        (b"something else", "neither a PLY nor a file of torch"),
        (b"", "neither a PLY nor a file of torch"),
    ):
        path.write_bytes(content)
        refused([path, checkpoint], message)
    np.savez(tmp_path / "x.npz", a=np.zeros((3, 4)))
    refused([tmp_path / "x.npz", checkpoint], r"holds arrays \(3, 4\)")


SAMPLES = {
    "checkpoint": lambda folder: save_model(folder / "c.pth", G.take(ALL[:4]), tensor(VECTORS[0][:4])),
    "autoencoder": lambda folder: best_ckpt(folder, encoder=(8, 3), decoder=(5,)),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", SAMPLES)
def test_damage_anywhere_is_one_line(tmp_path, kind):
    path = SAMPLES[kind](tmp_path)
    plain = save_model(tmp_path / "plain_1.pth", G.take(ALL[:4]), tensor(LATENTS[0][:4]))
    given = [path] if kind == "checkpoint" else [path, plain]
    good, messages = path.read_bytes(), []
    generator = np.random.default_rng(0)
    for round_ in range(150):
        data = bytearray(good)
        place = int(generator.integers(len(data)))
        match round_ % 3:
            case 0:
                data = data[:place]
            case 1:
                data[place : place + 4] = generator.bytes(4)
            case _:
                del data[place : place + int(generator.integers(1, 9))]
        path.write_bytes(bytes(data))
        try:
            read_foreign(given)
        except InputError as error:
            messages.append(str(error))
    assert len(messages) > 40
    assert all("\n" not in message and str(tmp_path) in message for message in messages)
