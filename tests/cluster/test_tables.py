"""Tables of a comparison: medians, what is missing; its picture and its page."""

import csv
import dataclasses
import io
import math
from pathlib import Path

import numpy as np
import pytest
from finished_runs import run
from PIL import Image
from rich.console import Console

from cluster import stopping
from cluster.commands import compare
from cluster.compare import picture, tables
from cluster.compare.plan import Plan
from cluster.compare.report import page

PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, budget="1k")
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
