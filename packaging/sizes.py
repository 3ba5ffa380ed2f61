"""Print the size of every room beside its budget and goal, from the table in CONTRIBUTING.md (`make sizes`).

Exit code 1 where a room is larger than its budget.
"""

import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# | room | `pathspecs of git` | 1 234 lines or files | 1 000 |
ROW = re.compile(r"^\| ([^|]+) \| `([^`|]+)` \| ([\d ]+) (lines|files) \| ([\d ]+) \|$", re.MULTILINE)
COUNTED = (".py", ".js", ".glsl", ".css", ".html", ".md")


def size_of(pathspecs: str, unit: str) -> int:
    """Return how many lines, or files, the tracked files of a room have."""
    command = ["git", "ls-files", "-z", "--", *pathspecs.split()]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = [ROOT / name for name in listed.split("\0") if name.endswith(COUNTED)]
    there = [path for path in paths if path.is_file()]  # not those deleted since the last commit
    return len(there) if unit == "files" else sum(path.read_bytes().count(b"\n") for path in there)


def main() -> int:
    """Print a line for every room; 0 where all are within their budgets."""
    table = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    above = []
    for room, pathspecs, budget, unit, goal in ROW.findall(table):
        size, most = size_of(pathspecs, unit), int(budget.replace(" ", ""))
        said = "above its budget" if size > most else f"goal {goal}"
        print(f"{room:<24} {size:>6} of {most:>6} {unit}, {said}")
        above += [room] if size > most else []
    if above:
        print(f"too large: {', '.join(above)}; make it smaller, or raise its budget in CONTRIBUTING.md")
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main())
