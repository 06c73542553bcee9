"""The command gridsim-compare: wrong use, a kill, Ctrl-C."""

import csv
import io
import os
import signal
import subprocess
import sys
import time

import pytest
import tracked
from finished_runs import make_run

from cluster.commands import compare
from cluster.comparison.plan import Budget, ComparisonFolder, Plan
from gridsim.maps.scenarios import REGISTRY

ALL = tuple(REGISTRY)
PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, Budget(car_steps=1000))


CODE = "from cluster.commands.entry import compare_main; compare_main()"


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
