"""The paper's comparison: what a few seeds tell, what is trained once, what the tables say, what is refused."""

import csv
import dataclasses
import io
import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tracked
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from cluster import checkpoint, compare, experiment, report, tables
from cluster.cells import Cells, settings_of
from cluster.champion import Champion, evaluate, load_champion
from cluster.experiment import Budget, CellError, ComparisonFolder, Plan, open_comparison, read_runs, train
from cluster.finished import (
    ERROR_FIGURES,
    LEARNERS,
    RUN_FIGURES,
    Errors,
    ExperimentError,
    Run,
    errors_of,
    read_run,
)
from cluster.run import RunFolder
from cluster.settings import DqnSettings
from cluster.statistics import separation_by_chance, span_coverage, spread
from evolution.policy import PolicySpec
from gridsim.config import SimConfig
from gridsim.scenarios import REGISTRY

ALL = tuple(REGISTRY)
PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, Budget(car_steps=1000))
HELD_OUT = {"episodes": 64, "success_rate": 0.5, "distance_m": 900.0, "speed_mps": 7.0, "collision_rate": 0.5}


def make_run(folder, learner="evolution", scenario="curved", seed=0, traffic=0, **more):
    """A finished run's folder, as small as one can be. Returns its summary."""
    folder.mkdir(parents=True)
    genes = PolicySpec.parse("mlp:6,7").size
    genome = np.random.default_rng(abs(hash((learner, scenario, seed)))).standard_normal(genes).astype(np.float32)
    champion = Champion(genome, "mlp:6,7", scenario, SimConfig(), traffic)
    champion.save(folder / "champion.npz")
    settings = {"scenario": scenario, "seed": seed, "traffic": traffic, "observation": "rays", "population": 512}
    config = {"command": "gridsim-dqn" if learner == "dqn" else "gridsim-evolve", "settings": settings}
    if learner != "dqn":
        settings["search"] = learner
    summary = {
        "scenario": scenario, "seed": seed, "car_steps": 5000, "wall_s": 12.5, "champion_generation": 1,
        "champion_sha256": champion.sha256, "held_out": HELD_OUT, **more,
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "history.csv").write_text("generation,car_steps,wall_s\n0,1000,2.0\n1,3000,4.0\n2,5000,6.0\n")
    (folder / "summary.json").write_text(json.dumps(summary))
    return summary


def run(learner, scenario, seed, percent, training_s=10.0, success=0.9, traffic=0, observation="rays"):
    """A finished run with its errors."""
    figures = dict.fromkeys([*RUN_FIGURES, *ERROR_FIGURES], 1.0)
    figures |= {"velocity_error_percent": percent, "training_s": training_s, "success_rate": success}
    name = f"{scenario}-{learner}-s{seed}"
    return Run(Path(name), learner, scenario, seed, traffic, observation, name, figures)


# ------------------------------------------------------------------------------------------------------- statistics


def test_median_and_quartiles():
    found = spread([3.0, 1.0, 2.0])
    assert (found.n, found.median, found.lower, found.upper) == (3, 2.0, 1.5, 2.5)


@pytest.mark.parametrize("n", [2, 3, 4, 5])
def test_bootstrap_of_few_seeds_is_their_span(n):
    values = np.random.default_rng(n).normal(size=n)
    found = spread(values)
    assert (found.low, found.high) == (values.min(), values.max())


@pytest.mark.parametrize("n", [7, 9, 11])
def test_bootstrap_against_the_exact_distribution_of_a_resamples_median(n):
    """The median of a resample is at most the k-th value if more than half of n draws are among the first k."""

    def at_most(k):
        return sum(math.comb(n, j) * (k / n) ** j * (1 - k / n) ** (n - j) for j in range(n // 2 + 1, n + 1))

    values = np.arange(1.0, n + 1)
    found = spread(np.random.default_rng(0).permutation(values))
    assert found.low == next(k for k in values if at_most(k) > 0.025)
    assert found.high == next(k for k in values if at_most(k) >= 0.975)
    assert found == spread(values)


def test_what_was_not_measured_is_left_out():
    assert spread([math.nan, 4.0, math.inf]) == spread([4.0])
    assert spread([4.0]).low == spread([4.0]).high == 4.0
    nothing = spread([math.nan])
    assert nothing.n == 0
    assert math.isnan(nothing.median)


@given(st.lists(st.integers(-100, 100), min_size=1, max_size=6))
def test_spread_is_ordered(values):
    found = spread(values)
    assert min(values) <= found.low <= found.median <= found.high <= max(values)
    assert found.lower <= found.median <= found.upper


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_probabilities_against_all_outcomes(n):
    sides = list(itertools.product([False, True], repeat=n))  # of the median, on which each value lies
    assert span_coverage(n) == pytest.approx(sum(len(set(side)) == 2 for side in sides) / len(sides))
    ranks = list(itertools.combinations(range(2 * n), n))
    apart = [r for r in ranks if max(r) == n - 1 or min(r) == n]
    assert separation_by_chance(n, n) == pytest.approx(len(apart) / len(ranks))


# -------------------------------------------------------------------------------------------------- what is asked


@pytest.mark.parametrize(
    ("text", "steps", "seconds"),
    [
        ("20M", 20_000_000, 0), ("20,000,000", 20_000_000, 0), ("20_000", 20_000, 0), ("1.5k", 1500, 0), ("7", 7, 0),
        ("60s", 0, 60), ("5min", 0, 300), ("1.5h", 0, 5400), ("2G", 2 * 10**9, 0),
    ],
)  # fmt: skip
def test_budget_is_read(text, steps, seconds):
    budget = Budget.parse(text)
    assert budget == Budget(steps, seconds)
    assert Budget.parse(str(budget)) == budget


@given(st.integers(1, 10**13), st.integers(1000, 10**9))
def test_budget_is_written_exactly(steps, milliseconds):
    assert Budget.parse(str(Budget(steps))).car_steps == steps
    assert Budget.parse(str(Budget(wall_s=milliseconds / 1000))).wall_s == milliseconds / 1000


@pytest.mark.parametrize("text", ["", "20m", "-5", "0", "0s", "1e9", "60 parsecs", "99999h", "inf", "nan", "9" * 40])
def test_budget_that_makes_no_sense(text):
    with pytest.raises(ExperimentError, match="--budget"):
        Budget.parse(text)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scenarios": ("mars",)}, "unknown scenario"),
        ({"scenarios": ()}, "at least one"),
        ({"scenarios": ("city", "city")}, "twice"),
        ({"learners": ("sarsa",)}, "--learners"),
        ({"seeds": 0}, "--seeds"),
        ({"traffic": -2}, "--traffic"),
        ({"population": -1}, "--population"),
        ({"reference": "/nowhere.csv"}, "--reference"),
    ],
)
def test_plan_that_makes_no_sense(change, said):
    with pytest.raises(ExperimentError, match=said):
        dataclasses.replace(PLAN, **change).check()


def test_a_comparison_that_was_stopped_has_something_of_everything(tmp_path):
    cells = Plan(ALL, LEARNERS, 3, Budget(1)).cells(tmp_path)
    assert len({cell.folder for cell in cells}) == len(cells) == 45
    assert {(cell.scenario, cell.learner) for cell in cells[:15]} == set(itertools.product(ALL, LEARNERS))
    assert cells[0].folder == tmp_path / f"{ALL[0]}-evolution-s0"


# ------------------------------------------------------------------------------------------------------- execution


def executor(done, broken=()):
    """An Execute that makes a finished run at once and counts."""

    def execute(cell):
        done.append(cell.name)
        if cell.name in broken:
            raise CellError("the workers are gone")
        return make_run(cell.folder, cell.learner, cell.scenario, cell.seed, cell.traffic)

    return execute


def test_finished_runs_are_never_trained_again(tmp_path):
    done: list[str] = []
    told: list[str] = []
    cells = PLAN.cells(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        train(cells, executor(done), lambda cell, problem: stop_after(done, 3))
    assert done == [cell.name for cell in cells[:3]]
    assert train(cells, executor(done), lambda cell, problem: told.append(cell.name)) == 0
    assert done == [cell.name for cell in cells]
    assert told == done[3:]
    assert train(PLAN.cells(tmp_path), executor(done), lambda cell, problem: told.append(cell.name)) == 0
    assert len(done) == len(cells)


@pytest.mark.parametrize("observation", ["rays", "grid"])
def test_learners_see_the_same_and_settings_are_valid(tmp_path, observation):
    plan = dataclasses.replace(PLAN, observation=observation)
    specs = []
    for cell in plan.cells(tmp_path):
        settings = settings_of(cell)
        settings.check()
        specs.append(PolicySpec.parse(settings.policy))
    assert {spec.observation for spec in specs} == {observation}
    if observation == "rays":
        assert {spec.inputs for spec in specs} == {32}


def stop_after(done, count):
    if len(done) == count:
        raise KeyboardInterrupt


def test_a_run_that_fails_stops_no_other_and_is_tried_again(tmp_path):
    done: list[str] = []
    problems: list[str] = []
    cells = PLAN.cells(tmp_path)
    failed = train(cells, executor(done, {cells[1].name}), lambda cell, problem: problems.append(str(problem or "")))
    assert failed == 1
    assert problems == ["", "the workers are gone", *[""] * 6]
    assert train(cells, executor(done), lambda cell, problem: None) == 0
    assert done[len(cells) :] == [cells[1].name]


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


# ------------------------------------------------------------------------------------------------ damaged and hostile


@pytest.mark.parametrize("learner", ["evolution", "dqn"])
def test_champions_that_do_not_drive_as_their_summary_says_are_refused(tmp_path, learner):
    make_run(tmp_path / "r", learner)
    made = read_run(tmp_path / "r")
    metres = evaluate(load_champion(tmp_path / "r/champion.npz"), "curved", traffic=0)["distance_m"]
    weak = dataclasses.replace(made, figures={**made.figures, "distance_m": metres})
    assert set(errors_of(weak, "")) == set(ERROR_FIGURES)  # however short: it is no other version's
    other = dataclasses.replace(made, figures={**made.figures, "distance_m": 10.0 * metres + 10.0})
    with pytest.raises(ExperimentError, match="another version of GridSim made it"):
        errors_of(other, "")


def test_run_is_read(tmp_path):
    make_run(tmp_path / "a", "dqn", "seamless", 3)
    found = read_run(tmp_path / "a")
    assert (found.learner, found.scenario, found.seed) == ("dqn", "seamless", 3)
    figures = found.figures
    assert (figures["wall_s"], figures["training_s"]) == (12.5, 6.0)
    assert (figures["best_wall_s"], figures["best_car_steps"]) == (4.0, 3000.0)
    assert (figures["distance_m"], figures["success_rate"]) == (900.0, 0.5)


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("summary.json", None, "not finished"),
        ("config.json", None, "no run's folder"),
        ("history.csv", None, "cannot be read"),
        ("champion.npz", None, "no such file"),
        ("summary.json", "", "damaged"),
        ("summary.json", "{", "damaged"),
        ("summary.json", "[" * 100_000, "damaged"),
        ("summary.json", "[1]", "damaged"),
        ("summary.json", "{}", "do not belong together"),
        ("summary.json", '{"scenario": "curved", "seed": 0}', "no held_out"),
        ("config.json", '{"settings": []}', "no settings"),
        ("config.json", '{"settings": {"scenario": "curved", "seed": 0, "traffic": "x"}}', "damaged"),
        ("history.csv", "generation,car_steps,wall_s\n0,a,b\n", "damaged"),
        ("history.csv", "", "damaged"),
        ("history.csv", "generation,car_steps,wall_s\n0,1,1\n1,1,-1\n", "damaged"),
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
        {"seed": 4},
    ],
)
def test_edited_summary_is_refused(tmp_path, change):
    summary = make_run(tmp_path / "a")
    (tmp_path / "a/summary.json").write_text(json.dumps({**summary, **change}))
    with pytest.raises(ExperimentError):
        read_run(tmp_path / "a")


def test_same_run_twice_is_refused(tmp_path):
    make_run(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    with pytest.raises(ExperimentError, match="named twice"):
        read_runs([tmp_path / "a", tmp_path / "../" / tmp_path.name / "a"])
    with pytest.raises(ExperimentError, match="the same run"):
        read_runs([tmp_path / "a", tmp_path / "b"])


def test_a_comparison_stands_for_its_finished_runs(tmp_path):
    folder = ComparisonFolder(tmp_path, PLAN)
    folder.write()
    with pytest.raises(ExperimentError, match="none of its runs"):
        read_runs([tmp_path])
    make_run(PLAN.cells(tmp_path)[0].folder)
    assert [found.folder.name for found in read_runs([tmp_path])] == ["curved-evolution-s0"]


def test_comparison_is_opened_as_it_was_written(tmp_path):
    folder = ComparisonFolder(tmp_path, PLAN)
    folder.write()
    assert open_comparison(tmp_path) == folder


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2},
        {"plan": None},
        {"plan": {}},
        {"tracking_key": "'; drop table runs"},
        {"plan": {**PLAN.to_dict(), "extra": 1}},
        *[
            {"plan": {**PLAN.to_dict(), name: value}}
            for name, value in [
                ("seeds", "3"), ("seeds", True), ("seeds", -1), ("seeds", 10**9), ("scenarios", "curved"),
                ("scenarios", [["curved"]]), ("scenarios", ["../../etc"]), ("learners", ["evolution", "shell"]),
                ("budget", "a lot"), ("budget", 5), ("observation", "camera"), ("traffic", 1e9), ("reference", "/x"),
                ("population", -5),
            ]
        ],
    ],
)  # fmt: skip
def test_edited_comparison_is_refused(tmp_path, change):
    ComparisonFolder(tmp_path, PLAN).write()
    path = tmp_path / "comparison.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ExperimentError, match=r"comparison\.json") as refused:
        open_comparison(tmp_path)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "\0"])
def test_damaged_comparison_is_refused(tmp_path, text):
    (tmp_path / "comparison.json").write_text(text)
    with pytest.raises(ExperimentError, match=r"comparison\.json"):
        open_comparison(tmp_path)


def test_a_folder_is_worked_on_by_one_process(tmp_path):
    experiment.hold(tmp_path / "c")
    with pytest.raises(ExperimentError, match="another process is at work on it"):
        experiment.hold(tmp_path / "c")
    experiment.hold(tmp_path / "d")


@pytest.mark.parametrize(("budget", "every"), [("200k", 20_000), ("1G", DqnSettings.evaluate_every)])
def test_budget_is_looked_at_often_enough(tmp_path, budget, every):
    (cell,) = Plan(("curved",), ("dqn",), 1, Budget.parse(budget)).cells(tmp_path)
    settings = settings_of(cell)
    settings.check()
    assert isinstance(settings, DqnSettings)
    assert (settings.car_steps, settings.evaluate_every) == (cell.plan.budget.car_steps, every)


def test_a_run_that_was_killed_while_it_began_is_not_in_the_way(tmp_path):
    (cell,) = Plan(("curved",), ("dqn",), 1, Budget(car_steps=1_000_000)).cells(tmp_path)
    cell.folder.mkdir()
    (cell.folder / ".config.json.123.tmp").write_text("{")
    cell.check()
    (cell.folder / "thesis.tex").write_text("")
    with pytest.raises(ExperimentError, match="is in the way and no run"):
        cell.check()


def test_an_unfinished_run_that_was_edited_is_refused(tmp_path):
    (cell,) = Plan(("curved",), ("dqn",), 1, Budget(car_steps=1_000_000)).cells(tmp_path)
    settings = dataclasses.replace(settings_of(cell), car_steps=5)
    cell.folder.mkdir()
    edited = RunFolder(cell.folder, settings)
    edited.write_config()
    meta = dict.fromkeys(settings.counts, 0) | {"solved": False, "digest": edited.digest()}
    meta["tracking"] = {"uri": "", "key": "", "run_id": None}
    checkpoint.save(cell.folder / "checkpoint.npz", {}, meta)
    with pytest.raises(CellError, match=r"is not what comparison[.]json asks for; one of them was edited"):
        Cells(0, "", "", "gridsim")(cell)


def test_runs_that_are_not_what_the_comparison_asks_for_are_refused(tmp_path):
    cell = PLAN.cells(tmp_path)[0]
    make_run(cell.folder, seed=cell.seed)
    cell.check()
    with pytest.raises(ExperimentError, match="its traffic is 0"):
        dataclasses.replace(PLAN, traffic=4).cells(tmp_path)[0].check()
    with pytest.raises(ExperimentError, match="its population is 512"):
        dataclasses.replace(PLAN, population=64).cells(tmp_path)[0].check()
    shutil.move(cell.folder, PLAN.cells(tmp_path)[1].folder)
    with pytest.raises(ExperimentError, match="its learner is evolution"):
        PLAN.cells(tmp_path)[1].check()
    PLAN.cells(tmp_path)[2].folder.mkdir()
    (PLAN.cells(tmp_path)[2].folder / "mine.txt").write_text("dear diary")
    with pytest.raises(ExperimentError, match="in the way"):
        PLAN.cells(tmp_path)[2].check()


# ----------------------------------------------------------------------------------------------------------- tables


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


# ---------------------------------------------------------------------------------------------------------- command

CODE = "from cluster.entry import compare_main; compare_main()"


def refused(monkeypatch, capsys, *arguments):
    """What the command says when it is used wrongly."""
    monkeypatch.setattr(sys, "argv", ["gridsim-compare", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        compare.compare_main()
    said = capsys.readouterr().err
    assert stop.value.code == 2, said
    assert said.startswith("gridsim-compare: error: ")
    assert len(said.splitlines()) <= 3
    return said


def test_wrong_use_is_told_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ComparisonFolder(tmp_path, PLAN).write()
    make_run(tmp_path / "a")
    for arguments, said in [
        (["nowhere"], "no such folder"),
        ([tmp_path / "a" / "config.json"], "no folder"),
        (["a", "--seeds", 2], "--seeds"),
        (["--scenarios", "mars"], "unknown scenario"),
        (["--learners", "sarsa"], "sarsa"),
        (["--budget", "20m"], "--budget"),
        (["--workers", -1], "--workers"),
        (["--workers", 0, "--address", "auto"], "--address"),
        (["--resume", "nowhere"], "no such folder"),
        (["--resume", "a"], "no comparison's folder"),
        (["--resume", ".", "--budget", "2k"], "contradicts the comparison's 1k"),
        (["--resume", ".", "--seeds", 1], "contradicts the comparison's 2"),
        (["--resume", ".", "--learners", "dqn"], "contradicts the comparison's evolution random"),
        (["--name", "a", "--output", "."], "exists already"),
        (["--name", "../a"], "--name"),
        (["--tracking-uri", "ftp://x"], "not a tracking address"),
    ]:
        assert said in refused(monkeypatch, capsys, *arguments)
    assert sorted(os.listdir(tmp_path)) == ["a", "comparison.json"]


def begin(folder, *arguments):
    """The command, started in a folder."""
    return subprocess.Popen(
        [sys.executable, "-c", CODE, *arguments],
        cwd=folder, env=tracked.with_path(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip


def wait_until(condition, timeout_s=240.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def content(folder):
    return {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.e2e
def test_a_killed_comparison_goes_on_without_repeating_what_is_finished(tmp_path):
    asked = ["--scenarios", "curved", "--learners", "evolution", "random", "--seeds", "1", "--budget", "100M"]
    asked += ["--population", "32", "--generations", "3", "--workers", "0", "--name", "c"]
    folder = tmp_path / "runs" / "c"
    first, second = folder / "curved-evolution-s0", folder / "curved-random-s0"
    process = begin(tmp_path, *asked)
    try:
        wait_until(lambda: second.exists() or process.poll() is not None)
        assert process.poll() is None, process.communicate()
    finally:
        process.kill()
        process.communicate()
    before = content(first)
    assert "summary.json" in before

    process = begin(tmp_path, "--resume", "runs/c", "--workers", "0")
    said, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    assert errors == ""
    assert content(first) == before
    rows = list(csv.DictReader(io.StringIO((folder / "table.csv").read_text())))
    assert [(row["learner"], row["run"]) for row in rows] == [
        ("evolution", "curved-evolution-s0"),
        ("random", "curved-random-s0"),
    ]
    assert float(rows[0]["velocity_error_percent"]) > 0.0
    assert "| curved | random search | 1 |" in (folder / "table.md").read_text()
    assert (folder / "comparison.png").stat().st_size > 10_000

    found = {logged.info.run_name: logged for logged in tracked.runs(f"sqlite:///{tmp_path}/mlflow.db")}
    assert set(found) == {"c", first.name, second.name}
    assert len(tracked.runs(f"sqlite:///{tmp_path}/mlflow.db")) == 3
    parent = found["c"].info.run_id
    assert all(found[path.name].data.tags["mlflow.parentRunId"] == parent for path in (first, second))
    assert found["c"].info.status == "FINISHED"
    assert found["c"].data.metrics["runs_done"] == 2

    process = begin(tmp_path, "--resume", "runs/c", "--workers", "0")
    said, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    assert "2 of them finished" in said


@pytest.mark.e2e
def test_ctrl_c_keeps_what_is_done(tmp_path):
    asked = ["--scenarios", "curved", "--learners", "evolution", "random", "--seeds", "1", "--budget", "1h"]
    process = begin(tmp_path, *asked, "--population", "32", "--generations", "2", "--workers", "0", "--name", "c")
    folder = tmp_path / "runs" / "c"
    try:
        wait_until(lambda: (folder / "curved-random-s0").exists() or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        errors = process.communicate(timeout=120)[1]
    finally:
        process.kill()
    assert process.returncode == 130, errors
    assert "continue with: gridsim-compare --resume runs/c" in errors
    assert "| curved | random search | missing |" in (folder / "table.md").read_text()
    assert "| curved | evolution | 1 |" in (folder / "table.md").read_text()
