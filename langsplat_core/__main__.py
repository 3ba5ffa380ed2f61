"""The `langsplat` command, also as ``python -m langsplat_core`` for launchers such as torchrun."""

from langsplat_core.interrupts import end_in_a_line


def entry() -> None:
    """Run the `langsplat` console script."""
    end_in_a_line("langsplat")
    from langsplat_core.cli.app import entry as run

    run()


if __name__ == "__main__":
    entry()
