"""The `langsplat` command, also as ``python -m langsplat_core`` for launchers such as torchrun."""

import os

# Read when NumPy is imported: its products are small here, and BLAS's threads wait for one another by
# spinning, a tenth of a training's seconds. `compiled.Workers` shares out what is large.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from langsplat_core.interrupts import end_in_a_line


def entry() -> None:
    """Run the `langsplat` console script."""
    end_in_a_line("langsplat")
    from langsplat_core.cli.app import entry as run

    run()


if __name__ == "__main__":
    entry()
