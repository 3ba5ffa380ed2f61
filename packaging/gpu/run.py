"""Run on a machine with an NVIDIA GPU what never ran without one, and write its tables (`make gpu`).

    python packaging/gpu/run.py [--out docs/benchmarks/gpu] [--only raster,training] [--minutes 10]

Every section runs in a process of its own and within a time of its own; one that fails does not stop the
others. Needs nothing but Python itself: what a section lacks, it says. Exit code 0 where all that could run
ran, 1 where a section failed, 2 with one line where none could run; then nothing is written.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SECTIONS = {  # in this order, with the most seconds each may take
    "environment": 420,  # compiles gsplat
    "raster": 200,
    "gradients": 60,
    "lifting": 60,
    "training": 90,
    "opengl": 60,
    "encoders": 150,
    "tests": 120,
}
ON_GSPLAT = ("raster", "gradients", "lifting", "training")  # skipped where "environment" failed
ABSENT = 3  # exit code of a section that lacks what it is about
SAID = 25  # last lines of a section that failed


@dataclass(frozen=True)
class Outcome:
    """The outcome of a section."""

    name: str
    seconds: float
    state: str  # "ran", "failed", "skipped: why"
    said: str  # the end of its output where it failed

    @property
    def failed(self) -> bool:
        """True where it ended with an error or was stopped."""
        return self.state.startswith(("failed", "stopped"))


def run_section(name: str, plan: str, report: Path, limit: float) -> Outcome:
    """Run one section in its own process, for at most `limit` seconds."""
    paths = (HERE, ROOT, ROOT / "packaging" / "wheel", ROOT / "app")
    inherited = os.environ.get("PYTHONPATH")
    search = [str(path) for path in paths] + ([inherited] if inherited else [])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(search), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "gpu_sections", name, plan, str(report)]
    start = time.monotonic()
    with tempfile.TemporaryFile("w+") as log:
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
        try:
            code = process.wait(max(limit, 1.0))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            code = None
        log.seek(0)
        said = log.read().strip().splitlines()[-SAID:]
    seconds = time.monotonic() - start
    if code == 0:
        return Outcome(name, seconds, "ran", "")
    if code == ABSENT:
        return Outcome(name, seconds, f"skipped: {said[-1] if said else 'no reason given'}", "")
    state = f"stopped after {seconds:.0f} s" if code is None else f"failed (exit code {code})"
    return Outcome(name, seconds, state, "\n".join(said))


def summary(outcomes: list[Outcome], head: str) -> str:
    """Return the page that says what ran, what did not, and why."""
    lines = [
        "# On a machine with a GPU",
        "",
        "Written by `make gpu`, see [speed.md](../../speed.md#on-a-gpu).",
        "",
        head.strip(),
    ]
    lines += ["", "| section | seconds | outcome |", "|---|---|---|"]
    for outcome in outcomes:
        has_page = outcome.state == "ran" and outcome.name != "environment"  # which is the head of each page
        name = f"[{outcome.name}]({outcome.name}.md)" if has_page else outcome.name
        lines.append(f"| {name} | {outcome.seconds:.0f} | {outcome.state} |")
    for outcome in outcomes:
        if outcome.failed:
            lines += ["", f"## {outcome.name}: {outcome.state}", "", "```", outcome.said, "```"]
    return "\n".join(lines) + "\n"


def arguments() -> argparse.Namespace:
    """Parse and check the command line."""
    parser = argparse.ArgumentParser(description="Run on a GPU what never ran without one; write its tables.")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "docs" / "benchmarks" / "gpu", help="folder of the tables"
    )
    parser.add_argument(
        "--only", default="", help=f"sections, with commas between them; of {', '.join(SECTIONS)}"
    )
    parser.add_argument("--minutes", type=float, default=12.0, help="for all sections together, 0.1 to 600")
    parser.add_argument(
        "--plan", choices=("full", "tiny"), default="full", help="tiny: to try the script itself"
    )
    found = parser.parse_args()
    if not 0.1 <= found.minutes <= 600:
        parser.error(f"--minutes {found.minutes:g}: must lie in 0.1 to 600")
    unknown = sorted(set(filter(None, found.only.split(","))) - set(SECTIONS))
    if unknown:
        parser.error(f"--only {', '.join(unknown)}: no such section; choose of {', '.join(SECTIONS)}")
    return found


def main() -> int:
    """Run the sections that were asked for and write their tables; return the exit code."""
    asked = arguments()
    chosen = [name for name in SECTIONS if name in (asked.only.split(",") if asked.only else SECTIONS)]
    end = time.monotonic() + 60 * asked.minutes
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as scratch:
        reports = {name: Path(scratch) / f"{name}.md" for name in chosen}
        for name in chosen:
            if name in ON_GSPLAT and any(o.name == "environment" and o.failed for o in outcomes):
                outcome = Outcome(name, 0.0, "skipped: gsplat does not work here, see environment", "")
            else:
                limit = min(SECTIONS[name], end - time.monotonic())
                outcome = run_section(name, asked.plan, reports[name], limit)
            outcomes.append(outcome)
            print(f"{name}: {outcome.state}, {outcome.seconds:.0f} s", flush=True)
        if all(outcome.state.startswith("skipped") for outcome in outcomes):
            reasons = sorted({outcome.state.removeprefix("skipped: ") for outcome in outcomes})
            print(f"gpu: nothing could be run ({'; '.join(reasons)}); see docs/speed.md", file=sys.stderr)
            return 2
        write(asked.out, outcomes, reports)
    print(f"wrote {asked.out}")
    return int(any(outcome.failed for outcome in outcomes))


def write(folder: Path, outcomes: list[Outcome], reports: dict[str, Path]) -> None:
    """Write a page for every section that found something, and the summary."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = reports.get("environment")
    head = environment.read_text() if environment and environment.exists() else ""
    for name, report in reports.items():
        if report.exists() and name != "environment":
            (folder / f"{name}.md").write_text(f"{report.read_text().strip()}\n\n## Machine\n\n{head}")
    (folder / "README.md").write_text(summary(outcomes, head))


if __name__ == "__main__":
    sys.exit(main())
