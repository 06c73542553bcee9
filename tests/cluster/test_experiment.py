"""The paper's comparison: what is asked, what is trained once, what is not what was asked for."""

import dataclasses
import json
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from finished_runs import make_run

from cluster.commands.cli import DqnFlags, EvolveFlags
from cluster.commands.common import parse
from cluster.compare.plan import UNLIMITED, Plan, limits, read_plan, read_runs, write_plan
from cluster.compare.processes import flags_of
from cluster.compare.results import LEARNERS
from cluster.compare.tables import group
from evolution.networks.policy import PolicySpec
from gridsim.errors import GridSimError
from gridsim.maps.scenarios import REGISTRY

PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, budget="1k")


def test_budget_is_read():
    for text, steps in (("20M", 20_000_000), ("20,000_000", 20_000_000), ("1.5k", 1500), ("2G", 2 * 10**9), ("7", 7)):
        assert limits(text) == (steps, 0)
    for text, seconds in (("60s", 60), ("5min", 300), ("1.5h", 5400)):
        assert limits(text) == (0, seconds)
    for text in ("", "20m", "-5", "0", "0s", "1e9", "60 parsecs", "99999h", "inf", "9" * 400):
        with pytest.raises(GridSimError, match="--budget"):
            limits(text)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scenarios": ("mars",)}, "unknown scenario"),
        ({"scenarios": ()}, "at least one"),
        ({"scenarios": ("city", "city")}, "same name"),
        ({"scenarios": ("/a/m.png", "/b/m.png")}, "same name"),
        ({"seeds": 0}, "--seeds"),
        ({"learners": ("dqn",), "population": -1}, "--population must be 4 to"),
        ({"grid": ("population=64,x",)}, "--grid population=64,x: give numbers"),
        ({"grid": ("sigma=1,1.0",)}, "same name"),
        ({"grid": ("seed=1,2",)}, "the comparison sets it"),
        ({"grid": ("sigma=1",), "learners": ("evolution", "dqn")}, "dqn has no such setting"),
    ],
)
def test_plan_that_makes_no_sense(change, said):
    with pytest.raises(GridSimError, match=said):
        dataclasses.replace(PLAN, **change).check()


def test_a_comparison_that_was_stopped_has_something_of_everything(tmp_path):
    planned = Plan(seeds=3).planned(tmp_path)
    assert len({run.path for run in planned}) == len(planned) == 60
    assert {(run.settings.scenario, run.settings.learner) for run in planned[:20]} == {*product(REGISTRY, LEARNERS)}
    assert planned[0].path == tmp_path / f"{next(iter(REGISTRY))}-evolution-s0"


def test_each_combination_of_a_grid_is_compared(tmp_path):
    plan = Plan(("curved",), ("evolution",), 2, grid=("policy=mlp:64,mlp:6,7", "sigma=0.3,0.5"))
    plan.check()
    planned = plan.planned(tmp_path)
    assert [run.name for run in planned[:4]] == [
        f"curved-evolution-policy=mlp_{policy}-sigma={sigma}-s0" for policy in ("64", "6_7") for sigma in (0.3, 0.5)
    ]
    make_run(planned[2].path, settings=planned[2].settings)
    groups = group(read_runs([planned[2].path]), plan)
    assert [(name, [bool(run.figures) for run in runs]) for (_, name), runs in groups.items()] == [
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
    for run in plan.planned(tmp_path):
        specs.setdefault(run.settings.learner, set()).add(PolicySpec.parse(run.settings.policy))
    assert set(specs) == set(LEARNERS)
    assert {spec.observation for found in specs.values() for spec in found} == {observation}
    assert specs["evolution"] == specs["two-parents"] == specs["random"]


def test_budgets_and_limits_are_those_of_each_run():
    for plan, generations in ((Plan(generations=5), 5), (Plan(), UNLIMITED)):
        assert vars(plan.settings("curved", "two-parents", 0))["generations"] == generations
    for budget, every in (("200k", 20_000), ("1G", 1_000_000)):
        settings = vars(Plan(budget=budget).settings("curved", "dqn", 0))
        assert (settings["car_steps"], settings["evaluate_every"]) == (limits(budget)[0], every)


def test_the_flags_of_a_run_give_its_settings():
    for plan in (
        Plan(budget="90s"),
        Plan(budget="200k", traffic=3, population=64, generations=5, seeds=2),
        Plan(observation="grid", learners=("evolution", "dqn"), grid=("policy=cnn:8,16,32@1,cnn:8,16,32@2",)),
        Plan(("city",), ("evolution",), grid=("policy=mlp:64+steering",)),  # a default, but not in traffic
        Plan(("curved",), ("two-parents",), grid=("mutation-rate=0.03,0.5", "elites=0,8")),
    ):
        plan.check()
        for run in plan.planned(Path("runs/c")):
            kind: Any = EvolveFlags if run.settings.command == "gridsim-evolve" else DqnFlags
            flags = parse(kind, run.settings.command, flags_of(run, wall_time=9.5))
            assert flags.learning == run.settings
            assert (flags.work.output, flags.run.name, flags.run.wall_time) == ("runs/c", run.name, 9.5)


def test_edited_comparison_is_refused(tmp_path):
    write_plan(tmp_path, PLAN)
    path = tmp_path / "comparison.json"
    whole = json.loads(path.read_text())
    changes: list[dict[str, Any]] = [
        {"seeds": "3"}, {"seeds": 10**9}, {"scenarios": [["curved"]]}, {"scenarios": ["../../etc"]}, {"budget": 5},
        {"observation": "camera"}, {"traffic": 1e9}, {"extra": 1},
    ]  # fmt: skip
    edited = [json.dumps({"plan": whole["plan"] | change}) for change in changes]
    for text in ("", "[]", "\0", '{"plan": null}', *edited):
        path.write_text(text)
        with pytest.raises(GridSimError, match=r"^.*comparison\.json.*$"):
            read_plan(tmp_path)
