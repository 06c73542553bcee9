"""The commands as a user runs them: installed scripts, real Ray workers, real kills."""

import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from commands import BIN, answers, descendants, duration_s, finish, rows, start, summary, wait_until

from cluster.commands.cli import REMOVED, EvolveFlags, evaluate_main, evolve_main
from cluster.commands.compare import compare_main
from cluster.commands.watch import watch_main
from cluster.comparison.plan import Budget, ComparisonFolder, Plan
from cluster.runs.checkpoint import save
from cluster.runs.run import RunFolder
from cluster.runs.settings import EvolveSettings

# Of all maps these are built fastest.
ROAD = ["--scenario", "curved", "--traffic", "2"]
SMALL = [*ROAD, "--population", "48", "--generations", "6", "--seed", "5"]


def evolve(*arguments, cwd, **env):
    """gridsim-evolve, run to its end."""
    return finish("gridsim-evolve", *arguments, cwd=cwd, **env)


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The undisturbed run, in one process."""
    cwd = tmp_path_factory.mktemp("reference")
    done = evolve("--workers", "0", "--name", "ref", *SMALL, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return cwd


@pytest.mark.e2e
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_champion_is_the_same_for_any_number_of_workers(reference, tmp_path, workers):
    done = evolve("--workers", str(workers), "--name", "w", *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""  # no warning of Ray's or MLflow's reaches the user
    assert summary(tmp_path / "runs/w")["champion_sha256"] == summary(reference / "runs/ref")["champion_sha256"]
    for mine, theirs in zip(rows(tmp_path / "runs/w"), rows(reference / "runs/ref"), strict=True):
        for name in ("fitness/best", "fitness/mean", "distance_m/mean", "car_steps", "leader/success_rate"):
            assert mine[name] == theirs[name]


@pytest.mark.e2e
def test_ctrl_c_saves_and_leaves_nothing_behind(reference, empty_database, tmp_path):
    from mlflow.tracking import MlflowClient

    shutil.copy(empty_database, tmp_path / "mlflow.db")  # a run waits for MLflow no more than 15 s then
    process = start("gridsim-evolve", "--workers", "2", "--name", "c", *SMALL, cwd=tmp_path)
    history = tmp_path / "runs/c/history.csv"
    wait_until(lambda: history.exists() and len(rows(tmp_path / "runs/c")) >= 2)
    children = descendants(process.pid)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in out + err
    assert "--resume runs/c" in err
    wait_until(lambda: not [c for c in children if Path(f"/proc/{c}").exists()], 30)
    client = MlflowClient(tracking_uri=f"sqlite:///{tmp_path}/mlflow.db")
    experiment = client.get_experiment_by_name("gridsim")
    assert experiment is not None
    (run,) = client.search_runs([experiment.experiment_id])
    assert run.info.status == "KILLED"
    assert duration_s(tmp_path / "runs/c") == pytest.approx(float(rows(tmp_path / "runs/c")[-1]["wall_s"]), abs=0.01)
    done = evolve("--workers", "2", "--resume", "runs/c", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert duration_s(tmp_path / "runs/c") == pytest.approx(summary(tmp_path / "runs/c")["wall_s"], abs=0.01)
    assert summary(tmp_path / "runs/c")["champion_sha256"] == summary(reference / "runs/ref")["champion_sha256"]


@pytest.mark.e2e
def test_existing_cluster(reference, cluster, tmp_path):
    """As the README says: ray start, then --address."""
    address, _ = cluster(2)
    done = evolve("--workers", "2", "--address", address, "--name", "a", *SMALL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert summary(tmp_path / "runs/a")["champion_sha256"] == summary(reference / "runs/ref")["champion_sha256"]
    assert answers(address)  # the run left, the cluster stays


def test_tests_take_nothing_from_the_machines_home_and_shell(root, tmp_path):
    code = "import conftest, os, pathlib, gridsim.jit as jit; print(pathlib.Path.home(), jit.CACHE_FOLDER, *os.environ)"
    shell = {"HOME": str(tmp_path), "RAY_ADDRESS": "x", "RAY_AUTH_MODE": "token", "MLFLOW_TRACKING_URI": "x"}
    env = {name: value for name, value in os.environ.items() if name not in ("XDG_CACHE_HOME", "GRIDSIM_CACHE_DIR")}
    env["PYTHONPATH"] = f"{root / 'tests'}{os.pathsep}{root / 'tests/support'}"
    home, cache, *names = subprocess.run(
        [sys.executable, "-c", code], cwd=root, env=env | shell, check=True, capture_output=True, text=True
    ).stdout.split()
    assert not Path(home).is_relative_to(tmp_path)
    assert Path(cache).is_relative_to(tmp_path / ".cache"), "kernels are compiled once for all sessions"
    assert not set(shell) - {"HOME"} & set(names)


@pytest.mark.e2e
def test_run_folder_and_mlflow_keep_their_contracts(reference):
    from mlflow.tracking import MlflowClient

    folder = reference / "runs/ref"
    for name in ("config.json", "checkpoint.npz", "champion.npz", "elites.npz", "curves.png", "trajectory.png"):
        assert (folder / name).stat().st_size > 0
    figures = summary(folder)
    with np.load(folder / "champion.npz", allow_pickle=False) as arrays:
        assert arrays["genome"].dtype == np.float32
    assert figures["held_out"]["episodes"] == 64
    assert len(rows(folder)) == figures["generations"] == 6
    client = MlflowClient(tracking_uri=f"sqlite:///{reference}/mlflow.db")
    run = client.get_run(figures["mlflow_run_id"])
    assert run.info.status == "FINISHED"
    assert run.data.tags["algorithm"] == "evolution"
    assert run.data.params["population"] == "48"
    for row in rows(folder):
        step = int(row["generation"])
        logged = {m.step: m.value for m in client.get_metric_history(run.info.run_id, "distance_m/best")}
        assert logged[step] == pytest.approx(float(row["distance_m/best"]))
    assert run.data.metrics["held_out/success_rate"] == figures["held_out"]["success_rate"]
    assert {"champion.npz", "summary.json", "curves.png"} <= {f.path for f in client.list_artifacts(run.info.run_id)}


@pytest.mark.e2e
def test_evaluate_says_what_the_run_said(reference):
    done = subprocess.run(
        [str(BIN / "gridsim-evaluate"), "runs/ref", "--json"],
        cwd=reference,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == pytest.approx(summary(reference / "runs/ref")["held_out"])


@pytest.mark.e2e
def test_config_repeats_and_init_continues(reference, tmp_path):
    config = reference / "runs/ref/config.json"
    done = evolve("--workers", "0", "--config", str(config), "--name", "again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert summary(tmp_path / "runs/again")["champion_sha256"] == summary(reference / "runs/ref")["champion_sha256"]
    champion = reference / "runs/ref"
    arguments = ["--workers", "0", *ROAD, "--population", "24", "--generations", "1"]
    arguments += ["--recombination", "two", "--mutation-rate", "0"]
    done = evolve(*arguments, "--init", str(champion), "--name", "warm", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # Without mutation every member is the one it started from.
    assert summary(tmp_path / "runs/warm")["champion_sha256"] == summary(reference / "runs/ref")["champion_sha256"]


@pytest.mark.e2e
@pytest.mark.parametrize("after_s", [0.0, 0.5, 1.5])
def test_sigterm_while_ray_starts_ends_soon_and_leaves_nothing(tmp_path, after_s):
    with tempfile.TemporaryDirectory(prefix="gs-") as short:  # Ray's sockets lie in it, and their paths must be short
        process = start("gridsim-evolve", "--workers", "2", *SMALL, cwd=tmp_path, RAY_TMPDIR=short)
        wait_until(lambda: list(Path(short).glob("ray/session_2*")))
        time.sleep(after_s)
        children = descendants(process.pid)
        began = time.monotonic()
        process.terminate()
        _, err = process.communicate(timeout=60)
        assert time.monotonic() - began < 5  # 0.2 s where nothing else is going on
        assert process.returncode == 143, err
        assert err.splitlines()[-1] == "gridsim-evolve: stopped; no generation was done yet"
        wait_until(lambda: not [c for c in children if Path(f"/proc/{c}").exists()], 10)
        assert list(Path(short).glob("ray/session_2*")) == []
    assert not (tmp_path / "runs").exists()


WRONG = {
    "rays policy on the grid": (["--observation", "grid", "--policy", "mlp:6,7"], "sees the rays"),
    "grid policy on rays": (["--policy", "cnn"], "--observation grid"),
    "other observation": (["--observation", "radar"], "radar"),
    "odd cnn": (["--observation", "grid", "--policy", "cnn:8,9,8"], "multiple"),
    "unknown scenario": (["--scenario", "moon"], "unknown scenario"),
    "unknown flag": (["--frobnicate"], "frobnicate"),
    "not a number": (["--population", "many"], "--population"),
    "population below elites": (["--recombination", "two", "--population", "8"], "--elites must be"),
    "elites of one centre": (["--elites", "4"], "--recombination two"),
    "other recombination": (["--recombination", "three"], "--recombination"),
    "islands, which are no more": (["--islands=4"], "--recombination all"),
    "negative workers": (["--workers", "-1"], "--workers"),
    "no patience": (["--patience", "-1"], "--patience must be 0 or more"),
    "output that cannot be written": (["--output", "/proc/nowhere"], "--output"),
    "name that is a path": (["--name", "../up"], "--name"),
    "resume of no run": (["--resume", "."], "no run's folder"),
    "config that is none": (["--config", "/etc/hostname"], "config.json"),
    "init that is missing": (["--init", "nothing.npz"], "nothing.npz"),
    "policy": (["--policy", "mlp:0"], "policy"),
    "negative traffic": (["--traffic", "-3"], "--traffic must be 0 to 100"),
    "traffic that no road holds": (["--traffic", "100000"], "--traffic must be 0 to 100"),
    "traffic that is no number": (["--traffic", "x"], "--traffic"),
    "dead cluster": (["--address", "127.0.0.1:1"], "127.0.0.1:1"),
    "dead MLflow": (["--tracking-uri", "http://127.0.0.1:1"], "127.0.0.1:1"),
    "MLflow file store": (["--tracking-uri", "file:///tmp/mlruns"], "file"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_use_is_one_clear_line(name, tmp_path):
    arguments, expected = WRONG[name]
    if "--workers" not in arguments and "--address" not in arguments:
        arguments = [*arguments, "--workers", "0"]
    began = time.monotonic()
    done = evolve(*arguments, cwd=tmp_path, timeout=60)
    assert done.returncode == 2, done.stderr
    lines = done.stderr.strip().splitlines()
    assert lines[0].startswith("gridsim-evolve: error: ")
    assert 1 <= len(lines) <= 3
    assert expected in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    assert time.monotonic() - began < 30
    assert list(tmp_path.iterdir()) == []  # nothing half-written


def said_by(monkeypatch, capsys, *arguments, main=evolve_main, prog="gridsim-evolve"):
    """What a command says on its standard error where it refuses to begin."""
    monkeypatch.setattr(sys, "argv", [prog, *arguments, "--workers", "0"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"{prog}: error: ")
    return err.splitlines()


@pytest.mark.parametrize(
    ("main", "line"),
    [
        (evaluate_main, "gridsim-evaluate r"),
        (watch_main, "gridsim-watch r --output a.mp4"),
        (evolve_main, "gridsim-evolve --workers 0 --init r"),
    ],
)
def test_an_unfinished_runs_missing_champion_is_told_with_how_to_go_on(main, line, monkeypatch, capsys, tmp_path):
    (tmp_path / "r").mkdir()
    RunFolder(tmp_path / "r", EvolveSettings("curved")).write_config()
    save(tmp_path / "r/checkpoint.npz", {}, {})
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", line.split())
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    first, *hint = capsys.readouterr().err.splitlines()
    assert first.endswith("if it was stopped, continue it with: gridsim-evolve --resume r")
    assert len(hint) == (main is watch_main)
    assert os.listdir(tmp_path) == ["r"]


INSTEAD = {
    "islands": "--recombination all",
    "island-car-steps": "--car-steps",
    "parents": "--tournament",
    "crossover": "--recombination",
    "bump-rate": "--sigma",
    "ranking": "fitness",
}


def test_every_flag_that_went_is_known():
    assert set(REMOVED) == set(INSTEAD)
    assert not {name.replace("-", "_") for name in REMOVED} & {f.name for f in dataclasses.fields(EvolveFlags)}


@pytest.mark.parametrize("form", ["--{} 3", "--{}=3", "--{}", "--{} 3 --help", "--seed 1 --{}=a=b"])
@pytest.mark.parametrize("flag", INSTEAD)
def test_a_flag_that_went_is_refused_by_name_with_what_takes_its_place(flag, form, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for spelling in (flag, flag.replace("-", "_")):
        (line,) = said_by(monkeypatch, capsys, *form.format(spelling).split())
        assert line.startswith(f"gridsim-evolve: error: --{flag} was removed: ")
        assert INSTEAD[flag] in line.split("was removed: ")[1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("value", ["parents", "crossover"])
def test_a_value_that_is_called_as_a_flag_that_went_is_a_value(value, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    lines = said_by(monkeypatch, capsys, "--name", value, "--population", "3")
    assert "population must be 4 or more" in lines[0]


def old_run(folder):
    """A run of version 0.1, as it left it."""
    folder.mkdir()
    settings = {"scenario": "curved", "population": 512, "parents": 64, "crossover": 0.0, "islands": 4}
    config = {"format": 1, "command": "gridsim-evolve", "gridsim": "0.1.0", "settings": settings}
    (folder / "config.json").write_text(json.dumps(config))
    save(folder / "checkpoint.npz", {"parents0": np.zeros((2, 3), dtype=np.float32)}, {"generation": 7})
    return folder


@pytest.mark.parametrize(("flag", "path"), [("--resume", "old"), ("--config", "old/config.json")])
def test_a_run_of_the_version_before_is_refused_in_one_line(flag, path, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    folder = old_run(tmp_path / "old")
    before = {entry.name: entry.read_bytes() for entry in folder.iterdir()}
    for form in ([flag, path], [f"{flag}={path}"]):
        (line,) = said_by(monkeypatch, capsys, *form)
        assert "old/config.json is of a run of GridSim 0.1" in line
        assert "start a new run" in line
    assert {entry.name: entry.read_bytes() for entry in folder.iterdir()} == before
    assert os.listdir(tmp_path) == ["old"]


@pytest.mark.parametrize("number", [0, 3, "1", None, True, [1], {}])
def test_a_config_of_another_format_is_refused_in_one_line(number, monkeypatch, capsys, tmp_path):
    folder = old_run(tmp_path / "old")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config | {"format": number}))
    (line,) = said_by(monkeypatch, capsys, "--resume", str(folder))
    assert "config.json" in line


def test_a_checkpoint_of_the_version_before_is_refused_beside_a_new_config(monkeypatch, capsys, tmp_path):
    folder = old_run(tmp_path / "old")
    RunFolder(folder, EvolveSettings("curved")).write_config()
    (line,) = said_by(monkeypatch, capsys, "--resume", str(folder))
    assert "do not belong together" in line


@pytest.mark.parametrize(("main", "prog"), [(evolve_main, "gridsim-evolve"), (compare_main, "gridsim-compare")])
def test_a_folder_that_another_process_works_on_is_refused_in_one_line(main, prog, monkeypatch, capsys, tmp_path):
    RunFolder(tmp_path, EvolveSettings("curved")).write_config()
    ComparisonFolder(tmp_path, Plan(("curved",), ("dqn",), 1, Budget(car_steps=1000))).write()
    hold = f"from cluster.runs.run import lock, Path; lock(Path({str(tmp_path)!r})); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout
        other.stdout.readline()
        (line,) = said_by(monkeypatch, capsys, "--resume", str(tmp_path), main=main, prog=prog)
        assert line.endswith(f"{tmp_path}: another process is at work on it; wait for it, or stop it")
        other.communicate(b"\n")
    (line,) = said_by(monkeypatch, capsys, "--resume", str(tmp_path))
    assert "has no checkpoint.npz" in line


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("change", "expected"),
    [(["--seed", "6"], "--seed"), (["--population", "64"], "--population"), (["--generations", "2"], "--generations")],
)
def test_resume_refuses_contradictions(reference, tmp_path, change, expected):
    done = evolve("--resume", str(reference / "runs/ref"), "--workers", "0", *change, cwd=tmp_path, timeout=60)
    assert done.returncode == 2
    assert expected in done.stderr
    assert len(done.stderr.strip().splitlines()) <= 3


@pytest.mark.e2e
def test_resume_refuses_damaged_checkpoints(reference, tmp_path):
    folder = tmp_path / "runs/ref"
    shutil.copytree(reference / "runs/ref", folder)
    whole = (folder / "checkpoint.npz").read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:2000] + b"x" + whole[2001:], b""):
        (folder / "checkpoint.npz").write_bytes(damaged)
        done = evolve("--resume", str(folder), "--workers", "0", cwd=tmp_path, timeout=60)
        assert done.returncode == 2
        assert re.match(r"gridsim-evolve: error: .*checkpoint.npz", done.stderr)
    (folder / "checkpoint.npz").write_bytes(whole)
    config = json.loads((folder / "config.json").read_text())
    config["settings"]["seed"] = 99
    (folder / "config.json").write_text(json.dumps(config))
    done = evolve("--resume", str(folder), "--workers", "0", cwd=tmp_path, timeout=60)
    assert done.returncode == 2
    assert "edited" in done.stderr


@pytest.mark.e2e
def test_a_finished_run_can_be_extended(reference, tmp_path):
    short = [*SMALL]
    short[short.index("6")] = "3"
    done = evolve("--workers", "0", "--name", "s", *short, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert duration_s(tmp_path / "runs/s") == pytest.approx(summary(tmp_path / "runs/s")["wall_s"], abs=0.01)
    again = evolve("--workers", "0", "--resume", "runs/s", cwd=tmp_path)
    assert again.returncode == 0
    assert "finished" in again.stdout
    done = evolve("--workers", "0", "--resume", "runs/s", "--generations", "6", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(rows(tmp_path / "runs/s")) == 6
    assert duration_s(tmp_path / "runs/s") == pytest.approx(summary(tmp_path / "runs/s")["wall_s"], abs=0.01)
    assert "compare: make ui" in done.stdout
    assert "http://127.0.0.1:5000/#/experiments/1/runs?workflowType=machine_learning&" in done.stdout
    assert summary(tmp_path / "runs/s")["champion_sha256"] == summary(reference / "runs/ref")["champion_sha256"]
