"""Tables of a comparison, what they say in words, and its picture."""

import csv
import io
from pathlib import Path

import numpy as np
from finished_runs import run
from PIL import Image

from cluster import report, tables
from cluster.experiment import Budget, Plan
from gridsim.scenarios import REGISTRY

ALL = tuple(REGISTRY)
PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, Budget(car_steps=1000))


def rows_of(text):
    """Cells of the tables in a markdown text, without heads and rules."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [line for line in lines if line[0] not in ("road", "---")]


def test_tables_show_what_is_missing():
    runs = [run("evolution", "curved", 0, 10.0), run("evolution", "curved", 1, 20.0), run("random", "seamless", 0, 5.0)]
    groups = tables.group(runs, PLAN)
    text = tables.table_md(groups, PLAN).decode()
    assert "5 of 8 runs are missing" in text
    driving, errors = rows_of(text)[:4], rows_of(text)[4:]
    assert [line[:3] for line in driving] == [
        ["curved", "evolution", "2"],
        ["curved", "random search", "missing"],
        ["seamless", "evolution", "missing"],
        ["seamless", "random search", "1 of 2"],
    ]
    assert errors[0][3:5] == ["15.0 (12.5 to 17.5)", "10.0 to 20.0"]
    assert set(errors[1][2:]) == {"–"}
    assert errors[3][3:5] == ["5.0", "–"]
    rows = list(csv.DictReader(io.StringIO(tables.table_csv(groups, Path()).decode())))
    assert [row["velocity_error_percent"] for row in rows] == ["10.0", "20.0", "", "", "", "", "5.0", ""]
    assert [(row["learner"], row["seed"]) for row in rows[2:4]] == [("random", "0"), ("random", "1")]


def test_runs_of_different_traffic_and_views_are_not_mixed():
    runs = [run("evolution", "city", 0, 1.0), run("evolution", "city", 0, 1.0, traffic=6)]
    assert [group.road for group in tables.group(runs)] == ["city, 0 cars", "city, 6 cars"]
    runs.append(run("evolution", "city", 1, 1.0, traffic=6, observation="grid"))
    assert {group.name for group in tables.group(runs)} == {"evolution on rays", "evolution on grid"}
    assert len(tables.group(runs)) == 3


def experiment_of(low, high, scenarios=ALL, **more):
    """Two seeds each, one percent apart; errors of evolution and of the DQN."""
    return tables.group(
        [
            run(learner, scenario, seed, percent[scenario] + seed, **more.get(learner, {}))
            for scenario in scenarios
            for learner, percent in (("evolution", low), ("dqn", high))
            for seed in range(2)
        ]
    )


LOW, HIGH = dict.fromkeys(ALL, 5.0), dict.fromkeys(ALL, 9.0)


def test_claim_holds():
    said = tables.findings(experiment_of(LOW, HIGH, evolution={"training_s": 5.0}))
    assert "claim that evolution's is smaller than the DQN's holds.**" in said[0]
    assert "highway (5.5 against 9.5 %)" in said[0]
    assert "No seed of one learner is among the other's on highway, curved" in said[0]
    assert "not smaller" not in said[0]
    assert "shorter than the DQN's on every road" in said[1]


def test_claim_holds_in_part():
    said = tables.findings(experiment_of(LOW, {**HIGH, "city": 4.5}, evolution={"training_s": 50.0}))
    assert "does not hold on all roads: on 4 of 5 only" in said[0]
    assert "not smaller on city (5.5 against 5.0 %)" in said[0]
    assert "Seeds overlap on city." in said[0]
    assert "shorter than the DQN's on 0 of 5 roads" in said[1]


def test_claim_does_not_hold():
    assert "does not hold on any road.**" in tables.findings(experiment_of(HIGH, LOW))[0]
    assert "does not hold on any road.**" in tables.findings(experiment_of(LOW, LOW))[0]  # equal is not smaller


def test_claim_is_about_all_five_roads():
    said = tables.findings(experiment_of(LOW, HIGH, ("city", "curved")))
    assert "holds on the 2 roads that were compared, not all five" in said[0]
    assert "cannot tell" in tables.findings(tables.group([run("evolution", "city", 0, 1.0)]))[0]


def test_small_errors_of_those_who_crash_are_no_praise():
    said = " ".join(tables.findings(experiment_of(LOW, HIGH, dqn={"success": 0.1})))
    assert "no praise where fewer than half of the held-out drives succeed: DQN on highway" in said
    assert "no praise" not in " ".join(tables.findings(experiment_of(LOW, HIGH)))


def test_few_seeds_are_not_oversold():
    said = tables.findings(experiment_of(LOW, HIGH))[-1]
    assert "probability of 50 %, not 95 %" in said
    assert "in 33 % of comparisons" in said
    assert "One seed" in tables.findings(tables.group([run("dqn", "city", 0, 1.0)]))[-1]


def test_picture_shows_who_was_compared(tmp_path):
    def has(path, colour):
        pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
        wanted = 0.75 * np.array(colour) + 0.25 * 255
        return (np.abs(pixels - wanted).max(axis=2) < 6).sum() > 500

    groups = experiment_of(LOW, HIGH)
    report.comparison(groups, tmp_path / "two.png")
    report.comparison([group for group in groups if group.learner == "evolution"], tmp_path / "one.png")
    evolution, dqn = (0x0B, 0x72, 0x85), (0xF0, 0x8C, 0x00)
    assert has(tmp_path / "two.png", evolution)
    assert has(tmp_path / "two.png", dqn)
    assert has(tmp_path / "one.png", evolution)
    assert not has(tmp_path / "one.png", dqn)
