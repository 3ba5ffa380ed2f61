"""`make gpu`: its sections over the twin of gsplat's kernels, and its runner where there is no GPU."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

from langsplat_core.raster.opengl.scene_textures import create_egl_context

ROOT = Path(__file__).resolve().parents[1]
GPU = ROOT / "packaging" / "gpu"


@pytest.fixture
def sections(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(GPU))
    return importlib.import_module("gpu_sections")


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """packaging/gpu/run.py."""
    spec = importlib.util.spec_from_file_location("gpu_run", GPU / "run.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "gpu_run", module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def fake_sections(tmp_path: Path, runner: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Sections that do as they are called, in place of the real ones."""
    (tmp_path / "gpu_sections.py").write_text(
        "import sys, time\nfrom pathlib import Path\n_, name, plan, report = sys.argv\n"
        "if name == 'opengl':\n    sys.exit(print('no driver', file=sys.stderr) or 3)\n"
        "Path(report).write_text(f'# {name}\\n\\nfound by {plan}\\n')\n"
        "if name == 'lifting':\n    time.sleep(60)\n"
        "if name == 'gradients':\n    raise ValueError('three\\nlines\\nof it')\n"
    )
    monkeypatch.setattr(runner, "HERE", tmp_path)
    monkeypatch.setattr(runner, "SECTIONS", {"environment": 60, "gradients": 60, "lifting": 5, "opengl": 60})
    return tmp_path


def pieces(sections: ModuleType, name: str) -> str:
    return "\n".join(getattr(sections, f"measure_{name}")(sections.TINY))


def numbers(text: str, first: str) -> list[float]:
    """Of the table's row that begins with `first`."""
    row = next(line for line in text.splitlines() if line.startswith(f"| {first} |"))
    return [float(cell) for cell in row.strip("| ").split(" | ")[1:] if cell != "-"]


@pytest.mark.long
def test_sections_over_the_twin(sections: ModuleType, gsplat_twin: None) -> None:
    said = pieces(sections, "gradients")
    for name in ("means", "log_scales", "quats_wxyz", "opacity_logits", "values", "means_px"):
        assert max(numbers(said, name)) < 1e-4
    assert max(numbers(said, "cuda")) < 1e-5
    said = pieces(sections, "lifting")
    assert numbers(said, "cpu")[1] == numbers(said, "cuda")[1] > 100
    assert float(said.split("Largest difference of a weight: ")[1].split()[0]) < 1e-4
    said = pieces(sections, "environment")
    assert "- gsplat: 1." in said
    assert "gsplat's first picture and its gradients" in said


@pytest.mark.slow
def test_longer_sections_over_the_twin(sections: ModuleType, gsplat_twin: None) -> None:
    said = pieces(sections, "raster")
    errors = [line.split(" | ")[8] for line in said.splitlines() if "| gather | cuda |" in line]
    assert errors
    assert max(map(float, errors)) < 1e-4
    assert "| 300 | 64x48 | 3 |" in said.split("On the device alone")[1]
    said = pieces(sections, "training")
    assert numbers(said, "cuda")[2] == pytest.approx(numbers(said, "cpu")[2], abs=0.5)
    assert " passed" in pieces(sections, "tests")
    assert "| loading, s | 5 crops, s |" in pieces(sections, "encoders")


@pytest.mark.long
def test_opengl_tables_on_any_driver(sections: ModuleType, gl_session: object) -> None:
    with create_egl_context() as context:
        said = "\n".join(sections.tables(sections.TINY, context))
    errors = [line.split(" | ")[8] for line in said.splitlines() if "| splat | opengl single |" in line]
    assert len(errors) == 2
    assert max(map(float, errors)) < 1e-4


@pytest.mark.long
@pytest.mark.skipif("__import__('torch').cuda.is_available()", reason="needs a machine without CUDA")
def test_without_a_gpu_it_says_so_in_one_line_and_writes_nothing(
    tmp_path: Path, runner: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["run.py", "--only", "environment,gradients", "--out", str(out)])
    monkeypatch.setenv("PYTHONPATH", "")
    assert runner.main() == 2
    said = capsys.readouterr()
    assert said.err == "gpu: nothing could be run (no CUDA device); see docs/speed.md\n"
    assert "gradients: skipped: no CUDA device" in said.out
    assert not out.exists()


def test_a_section_that_fails_or_takes_too_long_does_not_stop_the_others(
    fake_sections: Path, runner: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = fake_sections / "out"
    monkeypatch.setattr(sys, "argv", ["run.py", "--out", str(out)])
    monkeypatch.setattr(runner, "ON_GSPLAT", {"gradients"})
    assert runner.main() == 1
    page = (out / "README.md").read_text()
    assert "# environment\n\nfound by full" in page
    assert "| gradients | " in page
    assert "failed (exit code 1)" in page
    assert "of it\n```" in page
    assert "stopped after 5 s" in page
    assert "skipped: no driver" in page
    stopped = (out / "lifting.md").read_text()
    assert stopped.startswith("# lifting\n\nfound by full\n\n## Machine\n\n# environment")
    assert not (out / "opengl.md").exists()


def test_what_needs_gsplat_is_not_begun_where_it_does_not_work(
    fake_sections: Path, runner: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = fake_sections / "gpu_sections.py"
    main.write_text(main.read_text().replace("'gradients'", "'environment'"))
    monkeypatch.setattr(runner, "SECTIONS", {"environment": 60, "gradients": 60, "opengl": 60})
    monkeypatch.setattr(sys, "argv", ["run.py", "--out", str(fake_sections / "out")])
    assert runner.main() == 1
    page = (fake_sections / "out" / "README.md").read_text()
    assert "skipped: gsplat does not work here" in page


@pytest.mark.parametrize("words", [["--minutes", "0"], ["--only", "raster,tables"], ["--plan", "huge"]])
def test_unusable_arguments(
    words: list[str], runner: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["run.py", *words])
    with pytest.raises(SystemExit) as stop:
        runner.main()
    assert stop.value.code == 2
    assert words[0] in capsys.readouterr().err


def test_every_section_has_a_function_and_a_row_in_the_docs(runner: ModuleType, sections: ModuleType) -> None:
    page = (ROOT / "docs" / "speed.md").read_text()
    for name, limit in runner.SECTIONS.items():
        assert callable(getattr(sections, f"measure_{name}"))
        assert f"| {name} | {limit} |" in page


def test_the_wheels_are_those_of_the_constraints() -> None:
    constraints = (ROOT / "packaging" / "constraints.txt").read_text().split()
    for line in ("torch==2.13.0", "gsplat==1.5.3"):
        assert line in constraints
    assert "\ntorch==2.13.0\n" in (GPU / "requirements.txt").read_text()
    assert "\ngsplat==1.5.3 " in (GPU / "beside_torch.txt").read_text()
