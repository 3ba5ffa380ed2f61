"""Training: Gaussians from photographs (`radiance`), and the language field on them (`language`)."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Limit torch to one thread.

    Threads of torch wait by spinning and take cores from the rasterizer, while torch has little to compute on
    the CPU here (Adam, small layers). With two cores training is a third faster, on a busy machine far more.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
