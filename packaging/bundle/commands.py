"""`langsplat` of the one-folder build."""

from langsplat_core.cli.app import entry

entry()
