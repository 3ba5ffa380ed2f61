"""Training: Gaussians from photographs (`radiance`), and the language field on them (`language`)."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Keep torch to one thread.

    Torch's own threads wait by spinning and so take the cores from the rasterizer's; what torch does on the
    CPU here (loss, Adam, small layers) is little. With two cores training is a third faster, on a busy
    machine far more.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
