"""Finished runs: what is read and measured once, what is damaged, what is refused."""

import dataclasses
import json
import math

import pytest
from finished_runs import HELD_OUT, make_run

from cluster.comparison import results
from cluster.comparison.results import ERROR_FIGURES, LEARNERS, ExperimentError, errors_of, read_run, with_errors
from gridsim.errors import GridSimError


def test_errors_are_measured_once(tmp_path, monkeypatch):
    make_run(tmp_path / "a")
    kept, measured = tmp_path / "errors.json", []

    def measure(run, reference):
        measured.append(run.folder)
        return dict.fromkeys(ERROR_FIGURES, 2.5) | {"steering_error_deg": math.nan}

    monkeypatch.setattr(results, "errors_of", measure)
    for _ in range(2):
        found = with_errors(read_run(tmp_path / "a"), "", kept)
        assert found.figures["velocity_error_percent"] == 2.5
        assert math.isnan(found.figures["steering_error_deg"])
        assert found.figures["success_rate"] == 0.5
    assert len(measured) == 1
    for count, text in enumerate(("", "[]", "7"), 2):
        kept.write_text(text)
        with_errors(read_run(tmp_path / "a"), "", kept)
        assert len(measured) == count


def test_champions_that_do_not_drive_as_their_summary_says_are_refused(tmp_path):
    make_run(tmp_path / "r")
    made = read_run(tmp_path / "r")
    assert set(errors_of(made, "")) == set(ERROR_FIGURES)  # however short: it is no other version's
    other = dataclasses.replace(made, figures={**made.figures, "distance_m": 2000.0})
    with pytest.raises(ExperimentError, match="another version of GridSim made it"):
        errors_of(other, "")


@pytest.mark.parametrize("learner", LEARNERS)
def test_run_is_read(tmp_path, learner):
    make_run(tmp_path / "a", learner, "seamless", 3)
    found = read_run(tmp_path / "a")
    assert (found.learner, found.scenario, found.seed) == (learner, "seamless", 3)
    figures = found.figures
    assert (figures["wall_s"], figures["training_s"]) == (12.5, 6.0)
    assert (figures["best_wall_s"], figures["best_car_steps"]) == (4.0, 3000.0)
    assert (figures["distance_m"], figures["success_rate"]) == (90.0, 0.5)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("summary.json", None, "not finished"),
        ("config.json", None, "no run's folder"),
        ("champion.npz", None, "no such file"),
        *(("summary.json", text, "damaged") for text in ("", "{", "[" * 100_000, "[1]", "{}")),
        ("config.json", '{"settings": []}', "not a config.json"),
        ("champion.npz", "PK", "truncated|not a GridSim file"),
    ],
)
def test_damaged_run_is_refused(tmp_path, file, text, said):
    make_run(tmp_path / "a")
    if text is None:
        (tmp_path / "a" / file).unlink()
    else:
        (tmp_path / "a" / file).write_text(text)
    with pytest.raises(GridSimError, match=said) as refused:
        read_run(tmp_path / "a")
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"champion_sha256": "0" * 64}, "do not belong together"),
        ({"seed": 4}, "do not belong together"),
        ({"held_out": {**HELD_OUT, "distance_m": None}}, "damaged"),
        ({"held_out": None}, "damaged"),
        ({"held_out": {}}, "make it again with --resume"),
    ],
)
def test_edited_summary_is_refused(tmp_path, change, said):
    summary = make_run(tmp_path / "a")
    (tmp_path / "a/summary.json").write_text(json.dumps({**summary, **change}))
    with pytest.raises(ExperimentError, match=said):
        read_run(tmp_path / "a")
