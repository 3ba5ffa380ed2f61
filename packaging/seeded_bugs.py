"""Put small faults into a copy of the checkout, one at a time, and see which of them the tests notice.

    python packaging/seeded_bugs.py [--list] [--only NAME] [--out out/seeded_bugs.md]

The faults are in packaging/seeded_bugs.toml. Each runs the tests of its own package, without the slow tier,
until the first that fails. The table in --out has a line for each as soon as it is known; what is in it is
not run again, unless --only asks for it by a part of its name. Exit code 1 where a fault survived, or is not
where the list says.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PATIENCE = 3600  # seconds, after which a run counts as caught: the fault made it hang
HEAD = "| fault | in | outcome | first test that failed | seconds |\n|---|---|---|---|---|\n"


@dataclass(frozen=True)
class Fault:
    """A patch of a line or two."""

    name: str
    file: str  # below the root
    old: str  # occurs exactly once in it
    new: str
    tests: str  # folders and files below tests/

    def occurrences(self, root: Path) -> int:
        """Return how often the text to be replaced stands in the file."""
        path = root / self.file
        return path.read_text(encoding="utf-8").count(self.old) if path.is_file() else 0


def load_faults() -> list[Fault]:
    """Return the faults of the list, whose names differ."""
    table = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
    faults = [Fault(**entry) for entry in table["fault"]]
    assert len({fault.name for fault in faults}) == len(faults)
    return faults


def copy_checkout(to: Path) -> None:
    """Copy the tracked files as they are now, and compiled kernels where there are some."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).exists():  # not deleted in the working tree
            (to / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, to / name, follow_symlinks=False)
    for kernel in ROOT.glob("langsplat_core/**/__pycache__/*.nb[ic]"):
        copy = to / kernel.relative_to(ROOT)
        copy.parent.mkdir(exist_ok=True)
        shutil.copy2(kernel, copy)


def run_tests(root: Path, tests: list[str]) -> tuple[str, str]:
    """Run tests in a copy until one fails: the outcome, and the test that failed."""
    paths = os.pathsep.join(str(root / part) for part in (".", "app", "packaging/wheel"))
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no"]
    command += [f"tests/{name}" for name in tests]
    try:
        done = subprocess.run(
            command, cwd=root, env=environment, capture_output=True, text=True, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        return "caught", ""
    failed = re.search(r"^(?:FAILED|ERROR) tests/(.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    outcomes = {0: "SURVIVED", 1: "caught", 2: "caught"}  # 2: a module could not even be imported
    return outcomes.get(done.returncode, f"pytest ended with {done.returncode}"), failed[1] if failed else ""


def try_fault(fault: Fault, root: Path) -> list[str]:
    """Put a fault into the copy, run its tests and take it out again: the cells of its line."""
    path, package = root / fault.file, "/".join(fault.file.split("/")[1:])
    if (count := fault.occurrences(root)) != 1:
        return [fault.name, package, f"NOT THERE: its text occurs {count} times", "-", "-"]
    whole, began = path.read_text(encoding="utf-8"), time.monotonic()
    path.write_text(whole.replace(fault.old, fault.new), encoding="utf-8")
    try:
        outcome, failed = run_tests(root, fault.tests.split())
    finally:
        path.write_text(whole, encoding="utf-8")
    if outcome == "caught" and failed and run_tests(root, [failed])[0] != "SURVIVED":
        outcome = "its test fails without it"
    return [fault.name, package, outcome, failed, f"{time.monotonic() - began:.0f}"]


def read_table(path: Path) -> dict[str, str]:
    """Return the lines of a table by the names of their faults."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    return {line.split(" | ")[0].removeprefix("| "): line for line in lines if line.startswith("| ")}


def main() -> int:
    """Run what was asked for; 0 where every fault was caught."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--list", action="store_true", help="print the faults and run nothing")
    parser.add_argument("--only", default="", help="a part of the names of those that are run, again")
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "seeded_bugs.md", help="the table")
    options = parser.parse_args()
    faults = load_faults()
    if options.list:
        print(*(f"{fault.file}: {fault.name}" for fault in faults), sep="\n")
        return 0
    lines = read_table(options.out)
    chosen = [f for f in faults if (options.only in f.name if options.only else f.name not in lines)]
    if not chosen and options.only:
        parser.error(f"no fault has {options.only!r} in its name; --list prints them")
    with tempfile.TemporaryDirectory(prefix="seeded-") as folder:
        copy_checkout(Path(folder))
        for fault in chosen:
            cells = try_fault(fault, Path(folder))
            print(*cells, sep=" | ", flush=True)
            lines[fault.name] = f"| {' | '.join(cells)} |\n"
            text = HEAD + "".join(lines.get(each.name, "") for each in faults)
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(text, encoding="utf-8")
    caught = sum(" | caught | " in lines.get(fault.name, "") for fault in faults)
    print(f"{caught} of {len(faults)} faults are caught")
    return 0 if caught == len(faults) else 1


if __name__ == "__main__":
    sys.exit(main())
