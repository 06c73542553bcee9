"""Finished runs: what is read and measured once, what is damaged, what is refused."""

import dataclasses
import json

import pytest
from finished_runs import HELD_OUT, make_run

import gridsim
from cluster.compare.plan import read_runs
from cluster.compare.results import ERROR_FIGURES, measured, read_run
from gridsim.errors import GridSimError


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


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("summary.json", None, "not finished"),
        ("config.json", None, "not a run's folder"),
        *(("summary.json", text, "damaged") for text in ("", "[1]", "{}")),
        *(("config.json", text, "config.json") for text in ("", '{"format": 9}')),
        ("summary.json", {"held_out": {**HELD_OUT, "distance_m": None}}, "damaged"),
        ("summary.json", {"car_steps": 10**400}, "damaged"),
        ("summary.json", {"held_out": {}}, "make it again with --resume"),
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
