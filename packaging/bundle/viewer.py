"""`langsplat-viewer` of the one-folder build."""

from langsplat_viewer.__main__ import entry

entry()
