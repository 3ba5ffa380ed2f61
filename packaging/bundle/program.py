"""Both programs of the one-folder build: the name of the executable says which of them runs."""

import sys
from pathlib import Path

if Path(sys.executable).stem == "langsplat":
    from langsplat_core.cli.app import entry
else:
    from langsplat_viewer.__main__ import entry

entry()
