"""The `langsplat-viewer` command, also as ``python -m langsplat_viewer``."""

from langsplat_core.errors import end_in_a_line


def entry() -> None:
    end_in_a_line("langsplat-viewer")
    from langsplat_viewer.program import entry as run

    run()


if __name__ == "__main__":
    entry()
