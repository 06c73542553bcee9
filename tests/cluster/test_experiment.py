"""The paper's comparison: what is asked, what is trained once, what is not what was asked for."""

import dataclasses
import itertools
import json
import shutil

import pytest
from finished_runs import make_run
from hypothesis import given
from hypothesis import strategies as st

from cluster.comparison.cells import Cells, settings_of
from cluster.comparison.plan import Budget, CellError, ComparisonFolder, Plan, open_comparison, read_runs, train
from cluster.comparison.results import LEARNERS, ExperimentError
from cluster.runs import checkpoint
from cluster.runs.run import RunFolder
from cluster.runs.settings import DqnSettings
from evolution.networks.policy import PolicySpec
from gridsim.maps.scenarios import REGISTRY

ALL = tuple(REGISTRY)
PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, Budget(car_steps=1000))


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
    assert len({cell.folder for cell in cells}) == len(cells) == 60
    assert {(cell.scenario, cell.learner) for cell in cells[:20]} == set(itertools.product(ALL, LEARNERS))
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


@pytest.mark.parametrize(("observation", "traffic"), [("rays", 0), ("rays", 4), ("grid", 4)])
def test_searches_see_the_same_and_settings_are_valid(tmp_path, observation, traffic):
    roads = ("highway", "city") if traffic else PLAN.scenarios
    plan = dataclasses.replace(PLAN, scenarios=roads, observation=observation, traffic=traffic, learners=LEARNERS)
    specs: dict[str, set[PolicySpec]] = {}
    for cell in plan.cells(tmp_path):
        settings = settings_of(cell)
        settings.check()
        assert settings.learner == cell.learner
        specs.setdefault(cell.learner, set()).add(PolicySpec.parse(settings.policy))
    assert set(specs) == set(LEARNERS)
    assert {spec.observation for found in specs.values() for spec in found} == {observation}
    assert specs["evolution"] == specs["two-parents"] == specs["random"]
    if observation == "rays":
        assert {spec.inputs for spec in specs["evolution"]} == {64 if traffic else 33}, plan


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


# ------------------------------------------------------------------------------------------------ damaged and hostile


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


@pytest.mark.parametrize(("budget", "every"), [("200k", 20_000), ("1G", 1_000_000)])
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
