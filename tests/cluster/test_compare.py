"""The command gridsim-compare: wrong use, what is never trained again, a kill and Ctrl-C."""

import csv
import functools
import json
import os
import shutil
import signal
import tempfile
import time
from unittest.mock import Mock

import psutil  # type: ignore[import-untyped]
import pytest
import tracked
from commands import call, command_line, finish, refused, running, summary, wait_until
from finished_runs import make_run

from cluster.commands import compare, jobs
from cluster.commands.compare import compare_main
from cluster.commands.jobs import train_all
from cluster.compare import results
from cluster.compare.plan import ComparisonFolder, Plan
from cluster.run import Workers, undisturbed
from cluster.workers.pool import PoolError
from gridsim import evolve

NO_WORKERS = Workers(0, None, 0.0)
PLAN = Plan(("curved", "seamless"), ("evolution", "random"), 2, budget="1k")


def test_wrong_use_is_told_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ComparisonFolder(tmp_path, PLAN).write()
    make_run(tmp_path / "a")
    for arguments, said in [
        (["nowhere"], "no such folder"),
        (["."], "none of its runs is finished"),
        ([tmp_path / "a" / "config.json"], "is not a folder"),
        (["a", "--seeds", 2], "--seeds"),
        (["--scenarios", "mars"], "unknown scenario"),
        (["--learners", "dqn", "--population", -5], "--population must be positive, not -5"),
        (["--jobs", 0], "--jobs must be 1 to 256, not 0"),
        (["--workers", 0, "--address", "auto"], "--address"),
        (["--resume", "a"], "not a comparison's folder"),
        (["--resume", ".", "--seeds", 1], "contradicts the comparison's 2"),
        (["--resume", ".", "--learners", "dqn"], "contradicts the comparison's evolution random"),
        (["--name", "a", "--output", "."], "exists already"),
        (["--tracking-uri", "ftp://x"], "not a tracking address"),
    ]:
        assert said in refused(compare_main, monkeypatch, capsys, *arguments)[0]
    assert sorted(os.listdir(tmp_path)) == ["a", "comparison.json"]


def test_what_is_finished_is_never_trained_again_and_what_failed_stops_no_other(tmp_path, monkeypatch, capsys):
    trained: list[str] = []
    broken = {"seamless-evolution-s0"}

    def train(run, *_, **__):
        trained.append(run.name)
        if run.name in broken:
            raise PoolError("the workers are gone")
        make_run(run.path, settings=run.settings)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compare, "train", train)
    monkeypatch.setattr(results, "errors_of", lambda run: dict.fromkeys(results.ERROR_FIGURES, 2.5))
    monkeypatch.setattr(compare, "Tracker", Mock(**{"return_value.close.return_value": None}))
    run = functools.partial(call, compare_main, monkeypatch, capsys)
    asked = ["--scenarios", *PLAN.scenarios, "--learners", *PLAN.learners, "--budget", "1k", "--workers", 0]
    code, _, err = run(*asked, "--name", "c", "--seeds", 1)
    assert code == 1
    names = [cell.name for cell in PLAN.cells(tmp_path)]
    assert trained == names[:4]
    assert "gridsim-compare: seamless-evolution-s0 failed: the workers are gone" in err
    assert "gridsim-compare: error: 1 of 4 runs failed" in err
    assert err.splitlines()[-1].endswith("--resume runs/c")
    broken.clear()
    champion = tmp_path / "runs/c" / names[0] / "champion.npz"
    whole = champion.read_bytes()
    champion.write_text("PK")
    code, out, err = run("--resume", "runs/c", "--seeds", 2, "--budget", "1,000", "--workers", 0)
    assert code == 1
    assert "comparing 8 runs, 3 of them finished" in out
    assert trained[4:] == ["seamless-evolution-s0", *names[4:]]
    assert f"run 8/8  {names[-1]}: success 50%" in out
    assert f"gridsim-compare: {names[0]} failed: {champion}" in err
    assert "gridsim-compare: error: 1 of 8 runs failed" in err
    assert "| curved | evolution | 1 of 2 |" in (tmp_path / "runs/c/table.md").read_text()
    champion.write_bytes(whole)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")  # of a cluster that is gone, and not needed any more
    assert run("--resume", "runs/c", "--workers", 2)[0] == 0
    assert len(trained) == 9
    assert {"comparison.html", "table.md", "table.csv", "comparison.png"} <= set(os.listdir("runs/c"))
    assert json.loads((tmp_path / "runs/c/comparison.json").read_text())["plan"]["seeds"] == 2
    assert run("runs/c", "--name", "again")[0] == 0
    rows = list(csv.DictReader((tmp_path / "runs/again/table.csv").read_text().splitlines()))
    assert len(rows) == 8
    assert {row["velocity_error_percent"] for row in rows} == {"2.5"}


def fail(run, reporter):
    raise PoolError(f"no workers for {run.name}")


def test_each_job_goes_on_after_a_run_that_failed(tmp_path):
    cells, events = Plan(("curved",), ("evolution",), 5, budget="1k").cells(tmp_path), []
    train_all(cells, NO_WORKERS, fail, 2, lambda *event: events.append(event[1:]))
    assert sorted(said for kind, said in events if kind == "failed") == [f"no workers for {c.name}" for c in cells]


def close(run, reporter):
    """A run that is being closed when the signal comes, which it ignores."""
    with undisturbed():
        reporter.note("closing")
        time.sleep(1.0)


def test_a_job_that_ignored_the_signal_ends_as_soon_as_its_run_is_closed(tmp_path, monkeypatch):
    def interrupt(cell, kind, content):
        if content == "closing":
            raised.append(time.monotonic())
            raise KeyboardInterrupt

    raised: list[float] = []
    monkeypatch.setattr(jobs, "CLOSING_S", 20.0)
    with pytest.raises(KeyboardInterrupt):
        train_all(Plan(("curved",), ("evolution",), 1, budget="1k").cells(tmp_path), NO_WORKERS, close, 2, interrupt)
    assert time.monotonic() - raised[0] < 15.0


def test_a_comparison_is_resumed_while_its_server_is_away(tmp_path, impatient, monkeypatch, capsys):
    away = f"http://127.0.0.1:{tracked.free_port()}"
    folder = ComparisonFolder(tmp_path / "c", Plan(("curved",), ("evolution",), 1, budget="1k"), away)
    folder.path.mkdir()
    folder.write()
    monkeypatch.setattr(compare, "train", lambda run, *_, **__: make_run(run.path, settings=run.settings))
    monkeypatch.setattr(results, "errors_of", lambda run: dict.fromkeys(results.ERROR_FIGURES, 2.5))
    code, _, err = call(compare_main, monkeypatch, capsys, "--resume", folder.path, "--workers", 0)
    assert code == 0
    nested, unsent = err.splitlines()
    assert nested.endswith(f"its runs are not nested in MLflow: {away}: Connection refused")
    assert unsent.startswith(f"gridsim-compare: warning: not logged to MLflow at {away}: ")


def files(folder):
    return {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.rglob("*") if path.is_file()}


@pytest.mark.e2e
def test_a_comparison_stopped_by_ctrl_c_and_killed_goes_on_without_repeating_what_is_finished(tmp_path):
    folder = tmp_path / "runs" / "c"
    first, second = folder / "curved-evolution-s0", folder / "curved-random-s0"
    asked = "--scenarios curved --learners evolution random --seeds 1 --population 32 --budget 1h --generations 3"
    with running("gridsim-compare", *asked.split(), "--workers", "0", "--name", "c", cwd=tmp_path) as process:
        wait_until(lambda: second.exists() or process.poll() is not None, 240)
        process.send_signal(signal.SIGINT)
        errors = process.communicate(timeout=120)[1]
    assert process.returncode == 130, errors
    assert "gridsim-compare --resume runs/c" in errors
    assert "| curved | random search | missing |" in (folder / "table.md").read_text()
    assert "| curved | evolution | 1 |" in (folder / "table.md").read_text()
    with running("gridsim-compare", "--resume", "runs/c", "--workers", "0", cwd=tmp_path) as process:
        wait_until(lambda: (second / "checkpoint.npz").exists() or process.poll() is not None, 240)
    before = files(first)
    assert "summary.json" in before
    done = finish("gridsim-compare", "--resume", "runs/c", "--workers", "0", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert files(first) == before
    rows = list(csv.DictReader((folder / "table.csv").read_text().splitlines()))
    assert [(row["learner"], row["run"]) for row in rows] == [("evolution", first.name), ("random", second.name)]
    assert float(rows[0]["velocity_error_percent"]) > 0.0
    whole, *runs = sorted(tracked.runs(f"sqlite:///{tmp_path}/mlflow.db"), key=lambda run: run.info.run_name)
    assert [run.info.run_name for run in (whole, *runs)] == ["c", first.name, second.name]
    assert all(run.data.tags["mlflow.parentRunId"] == whole.info.run_id for run in runs)
    assert (whole.info.status, whole.data.metrics["runs_done"]) == ("FINISHED", 2)


@pytest.mark.e2e
def test_runs_trained_at_once_are_saved_survive_kills_and_have_the_champions_of_each_alone(tmp_path):
    folder = tmp_path / "runs" / "c"
    asked = "--scenarios curved seamless --learners evolution --seeds 2 --budget 1G --population 64 --generations 12"
    cells = Plan(("curved", "seamless"), ("evolution",), 2, budget="1G", population=64, generations=12).cells(folder)
    at_once = ["--workers", "0", "--jobs", "2"]

    def processes():
        servers = [each for each in psutil.Process(process.pid).children() if "forkserver" in command_line(each.pid)]
        return [child for server in servers for child in server.children()]

    short = tempfile.mkdtemp(prefix="gs-", dir="/tmp")  # the path of a socket in it must be short
    with running("gridsim-compare", *asked.split(), "--name", "c", *at_once, cwd=tmp_path, TMPDIR=short) as process:
        wait_until(
            lambda: all((cell.path / "checkpoint.npz").exists() for cell in cells[:2]) or process.poll() is not None,
            240,
        )
        children = processes()
        os.killpg(process.pid, signal.SIGTERM)
        errors = process.communicate(timeout=120)[1]
        assert process.returncode == 130, errors
        assert len(children) == 2
        assert not any(child.is_running() for child in children), "it has waited until they were saved"
    with running("gridsim-compare", "--resume", "runs/c", *at_once, cwd=tmp_path) as process:
        wait_until(lambda: len(processes()) == 2, 60)
        for child in processes():
            child.kill()
        errors = process.communicate(timeout=240)[1]
    assert process.returncode == 1, errors
    assert "failed: its process ended with exit code -9" in errors
    assert "gridsim-compare: error: 2 of 4 runs failed" in errors
    assert [(cell.path / "summary.json").exists() for cell in cells] == [False, False, True, True]
    done = finish("gridsim-compare", "--resume", "runs/c", *at_once, cwd=tmp_path, TMPDIR=short)
    assert (done.returncode, done.stderr) == (0, "")
    assert not [name for name in os.listdir(short) if name.startswith("pymp-")], "the folder of a socket"
    shutil.rmtree(short)
    for cell in cells:
        assert summary(cell.path)["champion_sha256"] == evolve(**vars(cell.settings))[0].sha256
