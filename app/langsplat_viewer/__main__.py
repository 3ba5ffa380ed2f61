"""The `langsplat-viewer` command, also as ``python -m langsplat_viewer``."""

from langsplat_core.interrupts import end_in_a_line


def entry() -> None:
    """Run the `langsplat-viewer` console script."""
    end_in_a_line("langsplat-viewer")
    from langsplat_viewer.program import entry as run

    run()


if __name__ == "__main__":
    entry()
