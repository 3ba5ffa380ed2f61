"""Processes that share one work: on several cores, GPUs or machines that see the same work folder.

    torchrun --nproc-per-node 2 -m langsplat_core train DATASET --out scene.ply

What is made goes through the work folder, item by item, so that a process that is lost costs only what it had
not finished; here is only who does what, and where all wait for each other.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar

from langsplat_core.errors import InputError

T = TypeVar("T")
PATIENCE = timedelta(days=7)  # radiance training is one process's work, and the others wait for it


@dataclass(frozen=True)
class Crew:
    """This process among all of them; alone by default."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this is the process that does what cannot be shared, and that speaks."""
        return self.rank == 0

    def share(self, items: Sequence[T]) -> list[T]:
        """The items that are this process's."""
        return list(items[self.rank :: self.size])

    def meet(self) -> None:
        """Wait for all. Raises InputError where one of them is no more."""
        if self.size < 2:
            return
        import torch.distributed

        try:
            torch.distributed.barrier()
        except RuntimeError as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(
                f"another process of this training ended ({reason[:80]}); give the same command again: what "
                "is finished is kept"
            ) from None

    def once(self, make: Callable[[], T]) -> T:
        """The result of `make`, which keeps it in a file: made by one process and read by the others."""
        if self.leads:
            result = make()
            self.meet()
            return result
        self.meet()
        return make()


def join_crew() -> Crew:
    """The crew that torchrun started this process in; a crew of one without it."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size < 2:
        return Crew()
    import torch.distributed

    if not torch.distributed.is_initialized():
        torch.distributed.init_process_group("gloo", timeout=PATIENCE)
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    return Crew(torch.distributed.get_rank(), torch.distributed.get_world_size())
