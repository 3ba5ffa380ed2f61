"""``python -m langsplat_core``: the `langsplat` command, for launchers such as torchrun."""

from langsplat_core.cli.app import entry

if __name__ == "__main__":
    entry()
