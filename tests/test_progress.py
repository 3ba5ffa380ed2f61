"""Progress as a value, in lines and in words; laps, measured where somebody watches."""

import threading
import time

import pytest

from langsplat_core.progress import LineProgress, Progress, Report, duration, lap, watched


def test_laps_of_one_name_are_summed():
    with watched() as laps:
        for _ in range(2):
            with lap("a"):
                time.sleep(0.01)
        with lap("b"):
            pass
    assert laps["a"] >= 20
    assert laps["b"] < laps["a"]
    with lap("c"):
        pass
    assert set(laps) == {"a", "b"}


def test_a_device_is_waited_for_only_where_somebody_watches():
    waited = []
    with lap("a", lambda: waited.append(1)):
        pass
    assert waited == []
    with watched() as laps, lap("a", lambda: time.sleep(0.01)):
        pass
    assert laps["a"] >= 10


def test_other_threads_are_not_watched():
    def work() -> None:
        with lap("elsewhere"):
            pass

    with watched() as laps:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert laps == {}


def test_an_error_passes_and_the_watch_ends():
    with pytest.raises(ValueError, match="oh"), watched(), lap("a"):
        raise ValueError("oh")
    with watched() as laps:
        pass
    assert laps == {}


def test_progress_as_lines_for_other_programs(capsys):
    with LineProgress() as progress:
        progress("a\n", 0.25, "one", loss=0.25)
        progress("a\n", 0.2501, "one", loss=0.250001)
        progress("b", 7.0)
    reports = [Report.from_json(line) for line in capsys.readouterr().err.splitlines()]
    assert reports == [Report("a\n", 0.25, "one", {"loss": 0.25}), Report("b", 1.0)]
    assert reports[0].text == "a\n: one, loss 0.2500"
    for line in (
        "plain words",
        '{"stage": 3}',
        '"text"',
        "[1]",
        '{"stage": "a", "fraction": 0, "metrics": 1}',
    ):
        with pytest.raises(ValueError):
            Report.from_json(line)


def test_durations_are_as_exact_as_a_forecast():
    found = [duration(seconds) for seconds in (0, 44, 89, 100, 3000, 9000)]
    assert found == ["10 s", "40 s", "90 s", "2 min", "50 min", "2 h"]
    assert (
        Report("a", 0.5, "b", {"psnr": 20.06, "seconds_left": 100}).text
        == "a: b, PSNR 20.1 dB, about 2 min left"
    )


def test_a_part_reports_within_the_whole():
    reports: list[Report] = []
    whole = Progress(reports.append)
    whole.part(1, 4)("inner", 0.5, "b", loss=1.0)
    whole.part(3, 4, "outer", "c")("inner", 1.0)
    assert reports == [Report("inner", 0.375, "b", {"loss": 1.0}), Report("outer", 1.0, "c")]
