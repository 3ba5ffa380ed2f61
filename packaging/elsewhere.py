"""Run the tests as on other machines and write docs/benchmarks/elsewhere.md (`make elsewhere`).

    python packaging/elsewhere.py [--only avx2,shuffled] [--newest PYTHON] [--seed 7]

Every row is a run of pytest, its output in elsewhere_out/NAME.txt. Its line is written when it ends, so that
an interrupted call keeps what was finished. Exit code 1 where a test failed or pytest did not end.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "docs" / "benchmarks" / "elsewhere.md"
OUT = ROOT / "elsewhere_out"
COMPUTING = (
    "raster scene query training semantics display extensions datasets making benchmarks io "
    "pipeline/test_train.py test_lowest_layers.py"
)
WRITING = "cli datasets io pipeline scene semantics test_writing.py"
HEAD = """# The tests on other machines

`make elsewhere` on {machine}; one row by `make elsewhere ONLY=avx2`. Two workers of pytest. Minutes are
the processor's, with the kernels' compilation where there were none yet.

| row | what is different | passed | failed | skipped | CPU minutes | at |
|---|---|---|---|---|---|---|
"""
# What NumPy has of its own for this processor, the highest step last.
STEPS = """from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__
print(*(name for name in __cpu_dispatch__ if __cpu_features__[name]))"""
TURKISH = "LC_ALL=tr_TR.ISO-8859-9 LOCPATH={tmp}"  # neither UTF-8 nor a decimal point
LOOP = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"


@dataclass(frozen=True)
class Row:
    """A machine that this one is not."""

    name: str
    environment: str = ""  # variables; {tmp} is a folder of the row's own
    before: str = ""  # the command that runs Python
    arguments: str = ""  # of pytest
    folders: str = COMPUTING
    loops: int = 0  # busy ones beside
    python: str = sys.executable

    @property
    def difference(self) -> str:
        """The cell of the table that says what is different."""
        other = "" if self.python == sys.executable else Path(self.python).resolve().name
        typed = (self.environment, self.before, self.arguments, other)
        beside = [f"{self.loops} busy loops beside"] if self.loops else []
        return ", ".join([f"`{part}`" for part in typed if part] + beside)


def rows(seed: int, newest: str) -> list[Row]:
    """Return all rows. The suite itself runs with one thread of OpenMP and in the files' order."""
    steps = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, text=True, check=True).stdout
    every = steps.split()
    avx512 = [name for name in every if "512" in name or name == "X86_V4"]
    later = [name for name in avx512 if name in ("AVX512_ICL", "AVX512_SPR")]
    libraries = (
        "OPENBLAS_CORETYPE={} NPY_DISABLE_CPU_FEATURES={} ATEN_CPU_CAPABILITY={} ONEDNN_MAX_CPU_ISA={} "
        "MKL_ENABLE_INSTRUCTIONS={}"
    )
    return [
        Row("sse", libraries.format("Prescott", ",".join(every), "default", "SSE41", "SSE4_2")),
        Row("avx2", libraries.format("Haswell", ",".join(avx512), "avx2", "AVX2", "AVX2")),
        Row("skylake", libraries.format("SkylakeX", ",".join(later), "avx512", "AVX512_CORE", "AVX512")),
        Row("numba", "NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= NUMBA_CACHE_DIR={tmp}"),
        Row("threads", "OMP_NUM_THREADS=4"),
        Row("one-core", before="taskset -c 0", folders=f"{COMPUTING} pipeline"),
        Row("busy", folders=f"{COMPUTING} pipeline", loops=2),
        Row("shuffled", arguments=f"--shuffle {seed}"),
        Row("turkish", f"{TURKISH} PYTHONUTF8=0 TZ=Pacific/Kiritimati", folders=WRITING),
        Row("c-locale", "LC_ALL=C TZ=America/St_Johns", folders=WRITING),
        Row("newest", python=newest),
    ]


def environment_of(row: Row, folder: str) -> dict[str, str]:
    """Return the environment variables of a row's process."""
    paths = os.pathsep.join(str(ROOT / part) for part in (".", "app", "packaging/wheel"))
    given = dict(pair.split("=", 1) for pair in row.environment.replace("{tmp}", folder).split())
    if "LOCPATH" in given:  # few systems have more than their own locale
        language, charset = given["LC_ALL"].split(".")
        made = Path(folder) / given["LC_ALL"]
        subprocess.run(["localedef", "-i", language, "-f", charset, made], check=True)
    return {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **given}


def run(row: Row) -> tuple[tuple[object, ...], bool]:
    """Run a row; return the tests passed, failed and skipped, the CPU minutes, and whether all went well."""
    command = f"{row.before} {row.python} -m pytest -n 2 --dist loadfile {row.arguments}".split()
    command += [f"tests/{name}" for name in row.folders.split()]
    log = OUT / f"{row.name}.txt"
    with tempfile.TemporaryDirectory() as folder, log.open("wb") as file, ExitStack() as loops:
        environment = environment_of(row, folder)
        for _ in range(row.loops):
            loops.callback(subprocess.Popen([sys.executable, "-c", LOOP]).kill)
        before = os.times()
        code = subprocess.run(command, cwd=ROOT, env=environment, stdout=file, stderr=file).returncode
        after = os.times()
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() or [""]
    print(*(line for line in lines if line.startswith(("FAILED", "ERROR"))), lines[-1], sep="\n", flush=True)
    counts = {kind: int(n) for n, kind in re.findall(r"(\d+) (passed|failed|skipped|error)", lines[-1])}
    failed = counts.get("failed", 0) + counts.get("error", 0) if code < 2 else f"ended with {code}"
    minutes = (sum(after[2:4]) - sum(before[2:4])) / 60  # of children
    return (counts.get("passed", 0), failed, counts.get("skipped", 0), f"{minutes:.1f}"), code == 0


def main() -> int:
    """Run what was asked for; 0 where nothing failed."""
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--only", default="", help="names of rows, with commas")
    parser.add_argument("--newest", default="", help="another Python, with all packages in it")
    parser.add_argument("--seed", type=int, default=1, help="of the shuffled order")
    options = parser.parse_args()
    if missing := [tool for tool in ("localedef", "taskset") if shutil.which(tool) is None]:
        parser.error(f"this needs {' and '.join(missing)}")
    every = rows(options.seed, options.newest)
    asked = set(filter(None, options.only.split(","))) or {row.name for row in every}
    if unknown := asked - {row.name for row in every}:
        parser.error(f"no such row: {', '.join(unknown)}; there are {', '.join(row.name for row in every)}")
    OUT.mkdir(exist_ok=True)
    describe = ["git", "describe", "--always", "--dirty"]
    commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True).stdout.strip() or "-"
    model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    head = HEAD.format(machine=f"{model[1] if model else 'an unknown processor'}, {os.cpu_count()} cores")
    good = True
    for row in every:
        if row.name in asked and row.python:
            print(f"{row.name}: {row.difference}", flush=True)
            cells, passed = run(row)
            good &= passed
            known = TABLE.read_text(encoding="utf-8").splitlines(keepends=True) if TABLE.exists() else []
            written = {line.split(" ")[1]: line for line in known if line.startswith("| ")}
            written[row.name] = f"| {' | '.join(map(str, (row.name, row.difference, *cells, commit)))} |\n"
            TABLE.write_text(head + "".join(written.get(other.name, "") for other in every), encoding="utf-8")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
