"""Finished runs: what is read and measured once, what is damaged, what is refused."""

import dataclasses
import json
import math

import pytest
from finished_runs import HELD_OUT, make_run

from cluster.comparison.results import ERROR_FIGURES, LEARNERS, Errors, ExperimentError, errors_of, read_run
from cluster.runs.champion import evaluate, load_champion


def test_errors_are_measured_once(tmp_path):
    make_run(tmp_path / "a")
    measured = []

    def measure(run, reference):
        measured.append(run.folder)
        return dict.fromkeys(ERROR_FIGURES, 2.5) | {"steering_error_deg": math.nan}

    for _ in range(2):
        found = Errors(tmp_path / "errors.json", "", measure).of(read_run(tmp_path / "a"))
        assert found.figures["velocity_error_percent"] == 2.5
        assert math.isnan(found.figures["steering_error_deg"])
        assert found.figures["success_rate"] == 0.5
    assert len(measured) == 1
    for text in ("", "[]", "{}", '{"errors": 7}'):
        (tmp_path / "errors.json").write_text(text)
        Errors(tmp_path / "errors.json", "", measure).of(read_run(tmp_path / "a"))
    assert len(measured) == 5


def test_champions_that_do_not_drive_as_their_summary_says_are_refused(tmp_path):
    make_run(tmp_path / "r")
    made = read_run(tmp_path / "r")
    metres = evaluate(load_champion(tmp_path / "r/champion.npz"), "curved", traffic=0)["distance_m"]
    weak = dataclasses.replace(made, figures={**made.figures, "distance_m": metres})
    assert set(errors_of(weak, "")) == set(ERROR_FIGURES)  # however short: it is no other version's
    other = dataclasses.replace(made, figures={**made.figures, "distance_m": 10.0 * metres + 10.0})
    with pytest.raises(ExperimentError, match="another version of GridSim made it"):
        errors_of(other, "")


@pytest.mark.parametrize("learner", LEARNERS)
def test_run_is_read(tmp_path, learner):
    make_run(tmp_path / "a", learner, "seamless", 3)
    found = read_run(tmp_path / "a")
    assert (found.learner, found.scenario, found.seed) == (learner, "seamless", 3)
    wanted = {"wall_s": 12.5, "training_s": 6.0, "best_wall_s": 4.0, "best_car_steps": 3000.0, "distance_m": 900.0}
    assert found.figures.items() >= wanted.items()


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("summary.json", None, "not finished"),
        ("config.json", None, "no run's folder"),
        ("champion.npz", None, "no such file"),
        ("summary.json", "", "damaged"),
        ("summary.json", "[" * 100_000, "damaged"),
        ("summary.json", "[1]", "damaged"),
        ("summary.json", "{}", "do not belong together"),
        ("summary.json", '{"scenario": "curved", "seed": 0}', "not the champion"),
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
    with pytest.raises(ExperimentError, match=said) as refused:
        read_run(tmp_path / "a")
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    "change",
    [
        {"champion_sha256": "0" * 64},
        {"held_out": {**HELD_OUT, "success_rate": 1.5}},
        {"held_out": {**HELD_OUT, "distance_m": None}},
        {"car_steps": True},
        {"wall_s": math.nan},
        {"held_out": {}},
        {"training_s": -1.0},
        {"best_wall_s": "4"},
        {"seed": 4},
    ],
)
def test_edited_summary_is_refused(tmp_path, change):
    summary = make_run(tmp_path / "a")
    (tmp_path / "a/summary.json").write_text(json.dumps({**summary, **change}))
    with pytest.raises(ExperimentError):
        read_run(tmp_path / "a")
