"""`langsplat ...`: thin commands, each a dataclass of arguments and one call into the layers below."""

import sys

from tyro.extras import SubcommandApp

from langsplat_core.cli.bench import BenchRaster
from langsplat_core.cli.bench_gains import BenchGains
from langsplat_core.cli.bench_lift import BenchLift
from langsplat_core.cli.bench_load import BenchLoad
from langsplat_core.cli.bench_memory import BenchMemory
from langsplat_core.cli.bench_paper import BenchPaper
from langsplat_core.cli.bench_phrases import BenchPhrases
from langsplat_core.cli.bench_query import BenchQuery
from langsplat_core.cli.bench_steps import BenchSteps
from langsplat_core.cli.bench_verdict import BenchVerdict
from langsplat_core.cli.bench_words import BenchWords
from langsplat_core.cli.compact import Compact
from langsplat_core.cli.convert import Convert
from langsplat_core.cli.demo import DemoBuild, DemoDataset, DemoEncoder, DemoSheet
from langsplat_core.cli.describe import Describe
from langsplat_core.cli.evaluate import EvalSynthetic
from langsplat_core.cli.evaluate_labels import EvalLerfOvs, EvalOvs3d, EvalScanNet
from langsplat_core.cli.inspect import Doctor, Inspect
from langsplat_core.cli.query import QueryScene
from langsplat_core.cli.run import Command, main
from langsplat_core.cli.scale import Scale
from langsplat_core.cli.select import Select
from langsplat_core.cli.train import train_command

# Options that are asked for often enough to have a short name.
ALIASES = {"--max-relevancy-error": "--codec.max-relevancy-error"}


def parse(args: list[str]) -> Command:
    demo, evaluate, bench = SubcommandApp(), SubcommandApp(), SubcommandApp()
    demo.command(name="build")(DemoBuild)
    demo.command(name="dataset")(DemoDataset)
    demo.command(name="encoder")(DemoEncoder)
    demo.command(name="sheet")(DemoSheet)
    evaluate.command(name="synthetic")(EvalSynthetic)
    evaluate.command(name="lerf-ovs")(EvalLerfOvs)
    evaluate.command(name="3d-ovs")(EvalOvs3d)
    evaluate.command(name="scannet")(EvalScanNet)
    bench.command(name="raster")(BenchRaster)
    bench.command(name="gains")(BenchGains)
    bench.command(name="lift")(BenchLift)
    bench.command(name="paper")(BenchPaper)
    bench.command(name="load")(BenchLoad)
    bench.command(name="memory")(BenchMemory)
    bench.command(name="phrases")(BenchPhrases)
    bench.command(name="query")(BenchQuery)
    bench.command(name="steps")(BenchSteps)
    bench.command(name="verdict")(BenchVerdict)
    bench.command(name="words")(BenchWords)
    app = SubcommandApp()
    app.command(name="train")(train_command(args))
    app.command(name="query")(QueryScene)
    app.command(name="describe")(Describe)
    app.command(name="select")(Select)
    app.command(name="scale")(Scale)
    app.command(name="convert")(Convert)
    app.command(name="compact")(Compact)
    app.command(name="inspect")(Inspect)
    app.command(name="doctor")(Doctor)
    app.command(demo, name="demo", help="Make the bundled scene, its photographs and its encoder.")
    app.command(evaluate, name="eval", help="Measure a scene against ground truth.")
    app.command(bench, name="bench", help="Speed against error, measured in one run.")
    args = [ALIASES.get(word, word) for word in args]
    command: Command = app.cli(
        prog="langsplat",
        description="Train, query, convert and measure 3D Gaussian scenes with a language field.",
        args=args,
    )
    return command


def entry() -> None:
    """The `langsplat` console script."""
    args = sys.argv[1:] or ["--help"]
    sys.exit(main("langsplat", lambda: parse(args)))
