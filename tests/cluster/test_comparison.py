"""Comparisons: what is asked, what is trained once, finished runs as they are read, their tables, picture and page."""

import csv
import dataclasses
import io
import json
import math
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished_runs import HELD_OUT, make_run, run
from PIL import Image
from rich.console import Console

import gridsim
from cluster import stopping
from cluster.commands import compare
from cluster.commands.cli import DqnFlags, EvolveFlags
from cluster.commands.common import parse
from cluster.compare import picture, tables
from cluster.compare.plan import UNLIMITED, Plan, limits, read_plan, read_runs, write_plan
from cluster.compare.processes import flags_of
from cluster.compare.report import page
from cluster.compare.results import ERROR_FIGURES, LEARNERS, measured, read_run
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
    assert len({each.path for each in planned}) == len(planned) == 60
    assert {(each.settings.scenario, each.settings.learner) for each in planned[:20]} == {*product(REGISTRY, LEARNERS)}
    assert planned[0].path == tmp_path / f"{next(iter(REGISTRY))}-evolution-s0"


def test_each_combination_of_a_grid_is_compared(tmp_path):
    plan = Plan(("curved",), ("evolution",), 2, grid=("policy=mlp:64,mlp:6,7", "sigma=0.3,0.5"))
    plan.check()
    planned = plan.planned(tmp_path)
    assert [each.name for each in planned[:4]] == [
        f"curved-evolution-policy=mlp_{policy}-sigma={sigma}-s0" for policy in ("64", "6_7") for sigma in (0.3, 0.5)
    ]
    make_run(planned[2].path, settings=planned[2].settings)
    groups = tables.group(read_runs([planned[2].path]), plan)
    assert [(name, [bool(each.figures) for each in runs]) for (_, name), runs in groups.items()] == [
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
    for each in plan.planned(tmp_path):
        specs.setdefault(each.settings.learner, set()).add(PolicySpec.parse(each.settings.policy))
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
        for each in plan.planned(Path("runs/c")):
            kind: Any = EvolveFlags if each.settings.command == "gridsim-evolve" else DqnFlags
            flags = parse(kind, each.settings.command, flags_of(each, wall_time=9.5))
            assert flags.learning == each.settings
            assert (flags.work.output, flags.run.name, flags.run.wall_time) == ("runs/c", each.name, 9.5)


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


# --- Finished runs ---------------------------------------------------------------------------------------------------


def test_runs_are_compared_from_python(tmp_path):
    make_run(tmp_path / "a", "two-parents", "curved", 1)
    make_run(tmp_path / "b", "dqn", "curved", 2)
    first, second = gridsim.compare(tmp_path / "a", tmp_path / "b")
    read = {
        "learner": "two-parents", "scenario": "curved", "seed": 1, "success_rate": 0.5, "distance_m": 90.0,
        "wall_s": 12.5, "training_s": 6.0, "best_wall_s": 4.0, "best_car_steps": 3000.0,
    }  # fmt: skip
    assert first.items() >= read.items()
    assert (second["run"], second["learner"], second["traffic"]) == (str(tmp_path / "b"), "dqn", 0)
    assert set(ERROR_FIGURES) <= set(first)
    with pytest.raises(GridSimError, match="not a run's folder"):
        gridsim.compare(tmp_path / "c")


def test_a_run_of_a_version_that_did_not_measure_kilometres_per_collision_is_compared(tmp_path):
    summary = make_run(tmp_path / "a")
    del summary["held_out"]["km_per_collision"]
    (tmp_path / "a" / "summary.json").write_text(json.dumps(summary))
    figures = read_run(tmp_path / "a").figures
    assert math.isnan(figures["km_per_collision"])
    assert figures["success_rate"] == 0.5


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("summary.json", None, "not finished"),
        ("config.json", None, "not a run's folder"),
        *(("summary.json", text, "damaged") for text in ("", "[1]", "{}")),
        *(("config.json", text, "config.json") for text in ("", '{"format": 9}')),
        ("summary.json", {"held_out": {**HELD_OUT, "distance_m": None}}, "damaged"),
        ("summary.json", {"car_steps": 10**400}, "damaged"),
        ("summary.json", {"held_out": {}}, "make it again with: gridsim-evolve --resume"),
    ],
)
def test_damaged_or_edited_run_is_refused(tmp_path, file, content, said):
    summary, path = make_run(tmp_path / "a"), tmp_path / "a" / file
    if content is None:
        path.unlink()
    else:
        path.write_text(json.dumps(summary | content) if isinstance(content, dict) else content)
    with pytest.raises(GridSimError, match=rf"^[^\n]*({said})[^\n]*$"):
        read_run(tmp_path / "a")


def test_a_champion_that_is_damaged_or_another_runs_is_told_as_its_errors_are_measured(tmp_path):
    make_run(tmp_path / "a")
    run, champion = read_run(tmp_path / "a"), tmp_path / "a/champion.npz"
    with pytest.raises(GridSimError, match=r"champion\.npz and summary\.json do not belong together"):
        measured(dataclasses.replace(run, champion_sha256="another"))
    champion.write_text("PK")
    with pytest.raises(GridSimError, match=r"^[^\n]*not a GridSim file[^\n]*$"):
        measured(run)


def test_the_same_run_in_two_folders_is_refused(tmp_path):
    folders = [tmp_path / "a/run", tmp_path / "b/run"]
    for folder in folders:
        make_run(folder)
    with pytest.raises(GridSimError, match="are the same run, made twice; leave one out"):
        read_runs(folders)


# --- Tables, picture and page ----------------------------------------------------------------------------------------

RUNS = [
    run("evolution", "curved", 0, 10.0), run("evolution", "curved", 1, 20.0), run("random", "curved", 1, math.nan),
    run("random", "seamless", 0, 5.0),
]  # fmt: skip


def test_tables_show_what_is_missing():
    groups = tables.group(RUNS, PLAN)
    text = tables.table_md(groups, PLAN).decode()
    assert text.startswith("2 seeds, at most 1k a run, 31 rays, traffic as each road has it by default.\n\n| road |")
    (_, *driving), (_, *errors) = (tables.table(groups, columns) for columns in (tables.DRIVING, tables.ERRORS))
    assert [line[:3] for line in driving] == [
        ["curved", "evolution", "2"],
        ["curved", "random search", "1 of 2"],
        ["seamless", "evolution", "missing"],
        ["seamless", "random search", "1 of 2"],
    ]
    assert set(errors[2][3:]) == {"–"}
    assert [line[4] for line in errors] == ["15.0 (12.5 to 17.5)", "–", "–", "5.0"]
    rows = list(csv.DictReader(io.StringIO(tables.table_csv(groups, Path()).decode())))
    assert [row["velocity_error_percent"] for row in rows] == ["10.0", "20.0", "", "", "", "", "5.0", ""]
    assert [(row["learner"], row["seed"]) for row in rows[2:4]] == [("random", "0"), ("random", "1")]


def test_the_page_links_to_the_drives_of_its_runs(tmp_path):
    there, gone = (dataclasses.replace(RUNS[k], folder=tmp_path / f"a b<{k}>") for k in (0, 1))
    there.folder.mkdir()
    (there.folder / "drive.html").touch()
    text = page(tmp_path / "<c>", tables.group([there, gone]), None, b"PNG").decode()
    assert '<td><a href="../a%20b%3C0%3E/drive.html">a b&lt;0&gt;</a><td>0<td>90<td>' in text
    assert "<td>a b&lt;1&gt;<td>1<td>90<td>" in text
    assert "<td>15.0 (12.5 to 17.5)" in text
    assert 'src="data:image/png;base64,UE5H"' in text
    assert "<title>GridSim: &lt;c&gt;</title>" in text


def test_runs_of_different_traffic_and_views_are_not_mixed():
    runs = [run("evolution", "city", 0, 1.0), run("evolution", "city", 0, 1.0, traffic=6)]
    assert list(tables.group(runs)) == [("city, 0 cars", "evolution"), ("city, 6 cars", "evolution")]
    runs.append(run("evolution", "city", 1, 1.0, traffic=6, observation="grid"))
    assert {name for _, name in tables.group(runs)} == {"evolution on rays", "evolution on grid"}


def test_maps_of_one_name_are_not_mixed():
    runs = [run("evolution", f"/{folder}/lab.png", 0, 1.0) for folder in "ab"]
    assert [road for road, _ in tables.group(runs[:1])] == ["lab"]
    assert [road for road, _ in tables.group(runs)] == ["/a/lab.png", "/b/lab.png"]
    assert b"/b/lab.png,0," in tables.table_csv(tables.group(runs), Path())


@pytest.mark.parametrize("plan", [None, PLAN])
def test_the_terminal_shows_the_tables_also_of_what_was_stopped(tmp_path, monkeypatch, plan):
    monkeypatch.setattr(stopping, "requested", lambda: True)  # so that errors are not measured, in seconds each
    shown = io.StringIO()
    assert compare._report(Console(width=80, file=shown), tmp_path, RUNS, plan) == 0
    text = shown.getvalue()
    assert max(map(len, text.splitlines()[:-1])) <= 80
    for word in ("evolution", "90", "15.0", "Fewer than 3 seeds are too few for a verdict."):
        assert word in text


def test_picture_shows_who_was_compared(tmp_path):
    colours = {"evolution": (0x0B, 0x72, 0x85), "dqn": (0xF0, 0x8C, 0x00)}
    for learners in (["evolution", "dqn"], ["evolution"]):
        runs = [run(learner, "city", seed, 5.0) for learner in learners for seed in range(2)]
        picture.comparison(tables.group(runs), tmp_path / "drawn.png")
        off = np.asarray(Image.open(tmp_path / "drawn.png").convert("RGB")) - 0.25 * 255  # bars let the white through
        near = {name: np.abs(off - 0.75 * np.array(colour)).max(axis=2) < 6 for name, colour in colours.items()}
        assert [name for name in colours if near[name].sum() > 500] == learners
