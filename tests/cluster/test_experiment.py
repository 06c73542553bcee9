"""The paper's comparison: what is asked, what is trained once, what is not what was asked for."""

import dataclasses
import itertools
import json
from pathlib import Path
from typing import Any

import pytest
from finished_runs import make_run

from cluster.commands.cli import DqnFlags, EvolveFlags
from cluster.commands.common import parse
from cluster.compare.plan import UNLIMITED, ComparisonFolder, Plan, limits, open_comparison, read_runs
from cluster.compare.results import LEARNERS
from cluster.compare.tables import group
from evolution.networks.policy import PolicySpec
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import REGISTRY

PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, budget="1k")


@pytest.mark.parametrize(
    ("text", "steps", "seconds"),
    [
        ("20M", 20_000_000, 0), ("20,000_000", 20_000_000, 0), ("1.5k", 1500, 0), ("2G", 2 * 10**9, 0), ("7", 7, 0),
        ("60s", 0, 60), ("5min", 0, 300), ("1.5h", 0, 5400),
    ],
)  # fmt: skip
def test_budget_is_read(text, steps, seconds):
    assert limits(text) == (steps, seconds)


@pytest.mark.parametrize("text", ["", "20m", "-5", "0", "0s", "1e9", "60 parsecs", "99999h", "inf", "nan", "9" * 40])
def test_budget_that_makes_no_sense(text):
    with pytest.raises(GridSimError, match="--budget"):
        limits(text)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scenarios": ("mars",)}, "unknown scenario"),
        ({"scenarios": ()}, "at least one"),
        ({"scenarios": ("city", "city")}, "each once"),
        ({"scenarios": ("/a/m.png", "/b/m.png")}, "same name"),
        ({"learners": ("sarsa",)}, "--learners"),
        ({"seeds": 0}, "--seeds"),
        ({"population": -1}, "population"),
        ({"grid": ("population=64,x",)}, "--grid population=64,x: give numbers"),
        ({"grid": ("sigma=1,1.0",)}, "same name"),
        ({"grid": ("seed=1,2",)}, "the comparison sets it"),
        ({"grid": ("population=64",), "population": 32}, "the comparison sets it"),
        ({"grid": ("sigma=1",), "learners": ("evolution", "dqn")}, "dqn has no such setting"),
    ],
)
def test_plan_that_makes_no_sense(change, said):
    with pytest.raises(GridSimError, match=said):
        dataclasses.replace(PLAN, **change).check()


def test_a_comparison_that_was_stopped_has_something_of_everything(tmp_path):
    roads = tuple(REGISTRY)
    cells = Plan(seeds=3).planned(tmp_path)
    assert len({cell.path for cell in cells}) == len(cells) == 60
    found = {(cell.settings.scenario, cell.settings.learner) for cell in cells[:20]}
    assert found == set(itertools.product(roads, LEARNERS))
    assert cells[0].path == tmp_path / f"{roads[0]}-evolution-s0"


def test_each_combination_of_a_grid_is_compared(tmp_path):
    plan = Plan(("curved",), ("evolution",), 2, grid=("policy=mlp:64,mlp:6,7", "sigma=0.3,0.5"))
    plan.check()
    cells = plan.planned(tmp_path)
    assert [cell.name for cell in cells[:4]] == [
        f"curved-evolution-policy=mlp_{policy}-sigma={sigma}-s0" for policy in ("64", "6_7") for sigma in (0.3, 0.5)
    ]
    make_run(cells[2].path, settings=cells[2].settings)
    groups = group(read_runs([cells[2].path]), plan)
    assert [(name, ["run" in row for row in rows]) for (_, name), rows in groups.items()] == [
        ("evolution, policy mlp:64, sigma 0.3", [False, False]),
        ("evolution, policy mlp:64, sigma 0.5", [False, False]),
        ("evolution, policy mlp:6,7, sigma 0.3", [True, False]),
        ("evolution, policy mlp:6,7, sigma 0.5", [False, False]),
    ]


@pytest.mark.parametrize(("observation", "traffic"), [("rays", 0), ("rays", 4), ("grid", 4)])
def test_searches_see_the_same_and_settings_are_valid(tmp_path, observation, traffic):
    plan = Plan(("highway", "city"), observation=observation, traffic=traffic)
    plan.check()
    specs: dict[str, set[PolicySpec]] = {}
    for cell in plan.planned(tmp_path):
        assert cell.name == f"{cell.settings.scenario}-{cell.settings.learner}-s{cell.settings.seed}"
        specs.setdefault(cell.settings.learner, set()).add(PolicySpec.parse(cell.settings.policy))
    assert set(specs) == set(LEARNERS)
    assert {spec.observation for found in specs.values() for spec in found} == {observation}
    assert specs["evolution"] == specs["two-parents"] == specs["random"]
    if observation == "rays":
        assert {spec.inputs for spec in specs["evolution"]} == {64 if traffic else 33}, plan


def test_generations_are_those_asked_for_or_without_bound():
    for plan, generations in ((Plan(generations=5), 5), (Plan(), UNLIMITED)):
        assert vars(plan.settings("curved", "two-parents", 0))["generations"] == generations


@pytest.mark.parametrize(("budget", "every"), [("200k", 20_000), ("1G", 1_000_000)])
def test_budget_is_looked_at_often_enough(budget, every):
    settings = vars(Plan(budget=budget).settings("curved", "dqn", 0))
    assert (settings["car_steps"], settings["evaluate_every"]) == (limits(budget)[0], every)


@pytest.mark.parametrize(
    "plan",
    [
        Plan(budget="90s"),
        Plan(budget="200k", traffic=3, population=64, generations=5, seeds=2),
        Plan(observation="grid", learners=("evolution", "dqn"), grid=("policy=cnn:8,16,32@1,cnn:8,16,32@2",)),
        Plan(("city",), ("evolution",), grid=("policy=mlp:64+steering",)),  # a default, but not in traffic
        Plan(("curved",), ("two-parents",), grid=("mutation-rate=0.03,0.5", "elites=0,8")),
    ],
)
def test_the_flags_of_a_run_give_its_settings(plan):
    plan.check()
    for run in plan.planned(Path("runs/c")):
        kind: Any = EvolveFlags if run.settings.command == "gridsim-evolve" else DqnFlags
        flags = parse(kind, run.settings.command, run.flags())
        assert flags.learning == run.settings
        assert (flags.work.output, flags.run.name) == ("runs/c", run.name)


@pytest.mark.parametrize(
    "change",
    [
        {"format": 2}, {"plan": None}, {"started": "yesterday"}, "", "[]", "\0", {"seeds": "3"},
        {"seeds": 10**9}, {"scenarios": [["curved"]]}, {"scenarios": ["../../etc"]}, {"learners": ["shell"]},
        {"budget": 5}, {"observation": "camera"}, {"traffic": 1e9}, {"extra": 1},
    ],
)  # fmt: skip
def test_edited_comparison_is_refused(tmp_path, change):
    ComparisonFolder(tmp_path, PLAN).write()
    path = tmp_path / "comparison.json"
    content = json.loads(path.read_text())
    if isinstance(change, dict) and not change.keys() <= content.keys():
        change = {"plan": content["plan"] | change}
    path.write_text(change if isinstance(change, str) else json.dumps(content | change))
    with pytest.raises(GridSimError, match=r"^.*comparison\.json.*$"):
        open_comparison(tmp_path)
