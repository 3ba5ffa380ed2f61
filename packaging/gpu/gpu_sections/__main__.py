"""One section: python -m gpu_sections NAME PLAN REPORT.md

Writes the report anew after every piece. Exit code 3, with the reason as the last line of stderr, where the
machine lacks what the section is about.
"""

import sys
from importlib import import_module
from pathlib import Path

from gpu_sections import PLANS, Missing
from langsplat_core.io.files import atomic_path

ABSENT = 3


def main(name: str, plan: str, report: Path) -> int:
    """See the module."""
    pieces: list[str] = []
    try:
        for piece in import_module(f"gpu_sections.{name}").measure(PLANS[plan]):
            pieces.append(piece)
            with atomic_path(report) as path:
                path.write_text("\n".join(pieces))
    except Missing as reason:
        print(reason, file=sys.stderr)
        return ABSENT
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2], Path(sys.argv[3])))
