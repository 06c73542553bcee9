"""The command gridsim-compare: wrong use, what is never trained again, failures, Ctrl-C, a kill."""

import csv
import json
import os
import signal
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import psutil  # type: ignore[import-untyped]
import pytest
import tracked
from commands import call, command_line, descendants, finish, refused, running, summary, wait_until
from finished_runs import make_run, with_errors

from cluster.commands import compare
from cluster.commands.compare import compare_main
from cluster.compare.plan import Plan, write_plan
from gridsim import evolve

PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, budget="1k")
ASKED = ["--scenarios", *PLAN.scenarios, "--learners", *PLAN.learners, "--budget", "1k"]
# In place of the learners' commands: puts a run that is made already where it belongs, or says why it cannot.
STAND_IN = """\
#!/bin/sh
for flag; do case $flag in --output=*) output=${flag#*=};; --name=*) name=${flag#*=};; esac; done
echo "$name $* $MLFLOW_TRACKING_URI $MLFLOW_RUN_CONTEXT" >> asked
echo "gridsim-evolve: warning: MLflow is slow" >&2
if [ -e "broken-$name" ]; then echo "gridsim-evolve: error: the workers are gone" >&2; exit 1; fi
if [ -e "killed-$name" ]; then kill -9 $$; fi
if [ -e "away-$name" ]; then echo "gridsim-evolve: warning: not logged to MLflow at h: 4 rows: no answer" >&2; fi
[ -e "$output/$name" ] || cp -r "made/$name" "$output/$name"
"""


def test_all_runs_of_a_comparison_drive_its_car():
    assert {run.settings.sim for run in Plan(sim="truck").planned(Path())} == {"truck"}


def test_wrong_use_is_told_in_one_line(here, monkeypatch, capsys):
    write_plan(here, PLAN)
    make_run(here / "a")
    wrong: list[tuple[list[object], str]] = [
        (["nowhere"], "not a run's folder"),
        (["."], "none of its runs is finished"),
        (["a", "--seeds", 2], "--seeds"),
        (["--scenarios", "mars"], "unknown scenario"),
        (["--sim", "truk"], "did you mean truck?"),
        (["--resume", ".", "--sim", "truck"], "contradicts the comparison's default"),
        (["--jobs", 0], "--jobs must be 1 to 256, not 0"),
        (["--resume", "a"], "not a comparison's folder"),
        (["--resume", ".", "--seeds", 1], "contradicts the comparison's 2"),
        (["--resume", ".", "--learners", "dqn"], "contradicts the comparison's evolution random"),
        (["--name", "a", "--output", "."], "exists already"),
        (["--tracking-uri", "ftp://x"], "not a tracking address"),
    ]
    for arguments, said in wrong:
        assert said in refused(compare_main, monkeypatch, capsys, *arguments)[0]
    assert sorted(os.listdir(here)) == ["a", "comparison.json"]


@pytest.fixture
def made(here, monkeypatch, capsys):
    """gridsim-compare in `here`, with STAND_IN in place of the learners' commands and without MLflow."""
    script = here / "gridsim-evolve"  # beside `call`'s gridsim-compare
    script.write_text(STAND_IN)
    script.chmod(0o755)
    for planned in PLAN.planned(here / "made"):
        make_run(planned.path, settings=planned.settings)
    tracking: Any = Mock(uri="http://u:hunter2@h:5000", error="no answer", run_id="", close=lambda status: None)
    tracking.wait_id.return_value = "17"
    monkeypatch.setattr(compare, "measured", with_errors)
    monkeypatch.setattr(compare, "check_uri", lambda *_: tracking.uri)
    monkeypatch.setattr(compare, "Tracking", lambda *_: tracking)
    return SimpleNamespace(run=partial(call, compare_main, monkeypatch, capsys), tracking=tracking)


def test_what_is_finished_is_never_trained_again_and_what_failed_stops_no_other(tmp_path, made):
    def asked():
        return [line.split()[0] for line in (tmp_path / "asked").read_text().splitlines()]

    names = [planned.name for planned in PLAN.planned(tmp_path)]
    for kind, name in zip(("away", "broken", "killed"), names[1:4], strict=True):
        (tmp_path / f"{kind}-{name}").touch()
    code, out, err = made.run(*ASKED, "--name", "c", "--seeds", 1)
    assert (code, asked()) == (1, names[:4])
    assert f"run 2/4  {names[1]}: success 50%, 90 m, 0.18 km per collision, 6 s  ETA 0:" in out
    for line in (
        f"{names[0]}: warning: MLflow is slow",
        f"{names[2]}: error: the workers are gone",
        f"gridsim-compare: {names[3]} failed: its process ended with exit code -9; see runs/c/logs/{names[3]}.log",
        "gridsim-compare: error: 2 of 4 runs failed",
    ):
        assert line in err.splitlines()
    assert err.splitlines()[-1].endswith("--resume runs/c")
    for kind, name in zip(("away", "broken", "killed"), names[1:4], strict=True):
        (tmp_path / f"{kind}-{name}").unlink()
    config = tmp_path / "runs/c" / names[0] / "config.json"
    whole = config.read_text()
    config.write_text(whole.replace('"sigma": 0.5', '"sigma": 0.25'))
    code, _, err = made.run("--resume", "runs/c")
    assert code == 2
    assert f"{config.parent} is not what comparison.json asks for" in err
    config.write_text(whole)
    code, out, _ = made.run("--resume", "runs/c", "--seeds", 2, "--jobs", 3)
    assert code == 0
    assert "comparing 8 runs, 2 of them finished" in out
    assert sorted(asked()[4:]) == sorted(names[1:]), "one of the finished ones to send what MLflow lacks of it"
    assert made.run("--resume", "runs/c")[0] == 0
    assert len(asked()) == 4 + 7
    assert {"comparison.html", "table.md", "table.csv", "comparison.png"} <= set(os.listdir("runs/c"))
    assert json.loads((tmp_path / "runs/c/comparison.json").read_text())["plan"]["seeds"] == 2
    assert made.run("runs/c", f"runs/c/{names[0]}", "--name", "again")[0] == 0
    rows = list(csv.DictReader((tmp_path / "runs/again/table.csv").read_text().splitlines()))
    assert len(rows) == 8, "each run once"
    assert {row["velocity_error_percent"] for row in rows} == {"2.5"}


def test_a_run_gets_the_password_and_the_parent_of_its_mlflow_run_in_its_environment(tmp_path, made):
    budget = ["--budget", "90s", "--learners", "evolution", "--scenarios", "curved", "--seeds", 1]
    code, _, err = made.run(*budget, "--name", "c", "--patience", 7, "--workers", 1, "--experiment", "mine")
    assert code == 1, "what is made is a run of another budget"
    assert "is not what comparison.json asks for" in err
    flags, environment = (tmp_path / "asked").read_text().split(" http://u:", 1)
    assert environment == 'hunter2@h:5000 {"mlflow.parentRunId": "17"}\n'
    for flag in ("wall-time=90.0", "patience=7.0", "workers=1", "experiment=mine", "tracking-uri=http://h:5000"):
        assert f" --{flag} " in f"{flags} "
    made.tracking.wait_id.return_value = ""
    made.run(*budget, "--name", "d")
    assert (tmp_path / "asked").read_text().endswith(" {}\n"), "its runs do not probe MLflow again"


def processes_of(process):
    lines = {pid: command_line(pid) for pid in descendants(process.pid)}
    return [
        psutil.Process(pid)
        for pid, line in lines.items()
        if "--resume-if-exists" in line and not line.startswith("/bin/sh")  # which ends it with the comparison
    ]


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_a_comparison_that_is_stopped_and_killed_goes_on_to_the_champions_of_each_run_alone(tmp_path):
    folder = tmp_path / "runs/c"
    planned = Plan(("curved",), ("evolution",), 3, budget="1G", population=64, generations=40).planned(folder)
    flags = "--scenarios curved --learners evolution --budget 1G --population 64 --generations 40 --seeds 2 --name c"
    at_once = ["--workers", "0", "--jobs", "2"]

    def saved():
        return process.poll() is not None or all((run.path / "checkpoint.npz").exists() for run in planned[:2])

    with running("gridsim-compare", *flags.split(), *at_once, cwd=tmp_path) as process:
        wait_until(saved, 240)
        children = processes_of(process)
        os.killpg(process.pid, signal.SIGINT)
        errors = process.communicate(timeout=60)[1]
    assert process.returncode == 130, errors
    assert "gridsim-compare --resume runs/c" in errors
    assert len(children) == 2
    assert not any(child.is_running() for child in children), "it has waited until they were saved"
    assert not any((run.path / "summary.json").exists() for run in planned)
    with running("gridsim-compare", "--resume", "runs/c", *at_once, cwd=tmp_path) as process:
        children = wait_until(lambda: len(found := processes_of(process)) == 2 and found, 60)
        wait_until(lambda: all("continuing" in log.read_text() for log in folder.glob("logs/*s[01].log")), 60)
        process.kill()
        assert psutil.wait_procs(children, 60)[1] == [], "they notice that it is gone"
    assert all("gridsim-evolve: stopped; continue with" in log.read_text() for log in folder.glob("logs/*s[01].log"))
    done = finish("gridsim-compare", "--resume", "runs/c", "--seeds", "3", *at_once, cwd=tmp_path)
    assert done.stderr == ""
    for run in planned[:2]:
        assert summary(run.path)["champion_sha256"] == evolve(**vars(run.settings))[0].sha256
    rows = list(csv.DictReader((folder / "table.csv").read_text().splitlines()))
    assert [row["run"] for row in rows] == [run.name for run in planned]
    assert float(rows[0]["velocity_error_percent"]) > 0.0
    logged = {run.info.run_name: run for run in tracked.runs(f"sqlite:///{tmp_path}/mlflow.db")}
    whole, nested = logged["c"], [logged[run.name] for run in planned]
    assert {run.data.tags["mlflow.parentRunId"] for run in nested} == {whole.info.run_id}
    assert (whole.info.status, whole.data.metrics["runs_done"]) == ("FINISHED", 3)
