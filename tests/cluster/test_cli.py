"""The commands as a user runs them: installed scripts, real Ray workers, real kills."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
import tracked
from commands import all_in_mlflow, descendants, finish, refused, rows, same_run, start, summary, wait_until

from cluster.commands.cli import dqn_main, evolve_main
from cluster.commands.compare import compare_main
from cluster.compare.plan import ComparisonFolder, Plan
from cluster.settings import EvolveSettings
from cluster.store.champion import Champion
from cluster.store.checkpoint import save
from cluster.store.folder import RunFolder
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

# Of all maps these are built fastest.
ROAD = ["--scenario", "curved", "--traffic", "2"]
SMALL = [*ROAD, "--population", "48", "--generations", "6", "--seed", "5"]
REFERENCE = ("gridsim-evolve", *SMALL)


def evolve(*arguments, cwd):
    return finish("gridsim-evolve", *arguments, cwd=cwd)


@pytest.mark.e2e
@pytest.mark.usefixtures("database")  # a run waits for MLflow no more than 15 s then
def test_ctrl_c_saves_and_leaves_nothing_behind(reference, tmp_path):
    run = tmp_path / "runs/c"
    process = start("gridsim-evolve", "--workers", "2", "--name", "c", *SMALL, cwd=tmp_path)
    wait_until(lambda: len(rows(run)) >= 2)
    children = descendants(process.pid)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in out + err
    assert "--resume runs/c" in err
    wait_until(lambda: not [c for c in children if Path(f"/proc/{c}").exists()], 30)
    (logged,) = (each.info for each in tracked.runs(f"sqlite:///{tmp_path}/mlflow.db") if each.info.run_name == "c")
    assert logged.status == "KILLED"
    assert (logged.end_time - logged.start_time) / 1000.0 == pytest.approx(float(rows(run)[-1]["wall_s"]), abs=0.01)
    evolve("--workers", "2", "--resume", "runs/c", cwd=tmp_path)
    assert same_run(run, reference)


def test_tests_take_nothing_from_the_machines_home_and_shell(root, tmp_path, monkeypatch):
    code = "import conftest, os, pathlib, gridsim.jit as jit; print(pathlib.Path.home(), jit.CACHE_FOLDER, *os.environ)"
    shell = {"HOME": str(tmp_path), "RAY_ADDRESS": "x", "RAY_AUTH_MODE": "token", "MLFLOW_TRACKING_URI": "x"}
    shell["PYTHONPATH"] = f"{root / 'tests'}{os.pathsep}{root / 'tests/support'}"
    for name in ("XDG_CACHE_HOME", "GRIDSIM_CACHE_DIR"):
        monkeypatch.delenv(name, raising=False)
    home, cache, *names = finish("python", "-c", code, cwd=root, **shell).stdout.split()
    assert not Path(home).is_relative_to(tmp_path)
    assert Path(cache).is_relative_to(tmp_path / ".cache"), "kernels are compiled once for all sessions"
    assert not set(shell) - {"HOME", "PYTHONPATH"} & set(names)


@pytest.mark.e2e
def test_run_folder_and_mlflow_keep_their_contracts(reference):
    home = reference.parent.parent
    stored = {path.name: path.read_bytes() for path in (home / "mlartifacts").rglob("*") if path.is_file()}
    for name in ("config.json", "champion.npz", "elites.npz", "curves.png", "trajectory.png", "drive.html"):
        assert stored[name] == (reference / name).read_bytes() > b""
    assert (reference / "checkpoint.npz").is_file()
    assert not (reference / "steps.part").exists()
    figures = summary(reference)
    assert len(rows(reference)) == figures["generations"] == 6
    assert all_in_mlflow(reference)
    run = tracked.client(f"sqlite:///{home}/mlflow.db").get_run(figures["mlflow_run_id"])
    assert run.data.tags["algorithm"] == "evolution"
    assert run.data.params["population"] == "48"
    assert run.data.metrics["distance_m/best"] == pytest.approx(float(rows(reference)[-1]["distance_m/best"]))
    assert run.data.metrics["held_out/success_rate"] == figures["held_out"]["success_rate"]
    done = finish("gridsim-evaluate", "runs/ref", "--json", cwd=home)
    assert done.stderr == ""
    assert json.loads(done.stdout) == pytest.approx(figures["held_out"])


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_config_repeats_a_run_and_a_finished_one_can_be_extended(reference, tmp_path):
    """The same run again, a part of it first: flags beside `--config` change it."""
    config, run = str(reference / "config.json"), tmp_path / "runs/s"
    evolve("--workers", "0", "--config", config, "--generations", "3", "--name", "s", cwd=tmp_path)
    assert "finished" in evolve("--workers", "0", "--resume", "runs/s", cwd=tmp_path).stdout
    done = evolve("--workers", "0", "--resume", "runs/s", "--generations", "6", cwd=tmp_path)
    assert same_run(run, reference)
    assert "compare: make ui, or" in done.stdout
    assert "at the end: 0.0% (in MLflow validation/success_rate; the table's is held_out/success_rate)" in done.stdout
    assert "--resume runs/s --generations 12\n" in done.stdout


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_init_begins_with_a_champion(reference, tmp_path):
    small = ["--population", "24", "--generations", "1", "--recombination", "two", "--mutation-rate", "0"]
    evolve("--workers", "0", *ROAD, *small, "--init", str(reference), "--name", "warm", cwd=tmp_path)
    # Without mutation every member is the one it started from.
    assert summary(tmp_path / "runs/warm")["champion_sha256"] == summary(reference)["champion_sha256"]


@pytest.mark.e2e
@pytest.mark.parametrize(
    ("send", "sign", "after_s"),  # killpg as timeout, Slurm and terminals do
    [(os.kill, signal.SIGTERM, 0.0), (os.killpg, signal.SIGTERM, 1.5), (os.killpg, signal.SIGINT, 0.5)],
)
def test_stopped_while_ray_starts_it_ends_soon_and_leaves_nothing(tmp_path, send, sign, after_s):
    with tempfile.TemporaryDirectory(prefix="gs-") as short:  # Ray's sockets lie in it, and their paths must be short
        many = [*ROAD, "--population", "30000"]  # of which a generation takes longer
        process = start("gridsim-evolve", "--workers", "2", *many, cwd=tmp_path, RAY_TMPDIR=short)
        wait_until(lambda: list(Path(short).glob("gs-*/r/session_2*")))
        time.sleep(after_s)
        children = descendants(process.pid)
        began = time.monotonic()
        send(process.pid, sign)
        _, err = process.communicate(timeout=60)
        assert time.monotonic() - began < 15  # 0.2 s where nothing else is going on
        assert process.returncode == 130, err
        assert err.splitlines()[-1] == "gridsim-evolve: stopped; no generation was done yet"
        wait_until(lambda: not [c for c in children if Path(f"/proc/{c}").exists()], 10)
        assert list(Path(short).iterdir()) == []
    assert not (tmp_path / "runs").exists()


WRONG = [
    ("--scenario moon", "unknown scenario"),
    ("--workers -1", "--workers"),
    ("--patience -1", "--patience must be 0 or more"),
    ("--output /proc/nowhere", "--output"),
    ("--name ../up", "--name"),
    ("--resume nowhere", "nowhere: no such folder"),
    ("--config /etc/hostname", "config.json"),
    ("--init nothing.npz", "nothing.npz: no such file"),
    ("--workers 1 --address 127.0.0.1:1", "127.0.0.1:1"),
    ("--tracking-uri http://127.0.0.1:1", "127.0.0.1:1: Connection refused; start one"),
]


@pytest.mark.parametrize(("arguments", "expected"), WRONG)
def test_wrong_use_is_one_clear_line(arguments, expected, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert expected in refused(evolve_main, monkeypatch, capsys, "--workers", "0", *arguments.split())[0]
    assert list(tmp_path.iterdir()) == []  # nothing half-written


@pytest.mark.parametrize(("flag", "path"), [("--resume", "old"), ("--config", "old/config.json")])
def test_a_run_of_the_version_before_is_refused_in_one_line(flag, path, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "old"
    folder.mkdir()
    config = {"format": 1, "command": "gridsim-evolve", "settings": {"scenario": "curved", "islands": 4}}
    (folder / "config.json").write_text(json.dumps(config))
    (line,) = refused(evolve_main, monkeypatch, capsys, flag, path)
    assert "old/config.json is of a run of GridSim 0.1, which this version cannot continue; start a new run" in line
    assert (os.listdir(tmp_path), os.listdir(folder)) == (["old"], ["config.json"])


@pytest.fixture
def stopped(tmp_path):
    """The folder of a run that was stopped."""
    run = RunFolder(tmp_path / "r", EvolveSettings("curved", population=48, generations=6, seed=5))
    run.path.mkdir()
    run.write_config()
    tracking = {"uri": "", "key": "", "run_id": None}
    save(run.path / "checkpoint.npz", {}, {"generation": 3, "car_steps": 9, "solved": False, "tracking": tracking,
                                           "digest": run.digest()})  # fmt: skip
    return run.path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("--seed 6", "--seed 6 contradicts the run's 5; leave it out, or start a new run"),
        ("--generations 2", "--generations 2 contradicts the run's 6; give a greater --generations, or start a new"),
        ("--car-steps 1e6", "--car-steps 1000000 does not limit the run; give a greater --generations"),
        ("--output elsewhere", "contradicts the run's"),
        ("--config r/config.json", "--resume and --config exclude each other"),
        ("--generations 9 --tracking-uri ftp://x", "not a tracking address"),  # no contradiction
    ],
)
def test_resume_refuses_contradictions(stopped, change, said, monkeypatch, capsys):
    monkeypatch.chdir(stopped.parent)
    (line,) = refused(evolve_main, monkeypatch, capsys, "--resume", "r", "--workers", "0", *change.split())
    assert said in line


def test_a_run_is_for_the_command_that_made_it(stopped, monkeypatch, capsys):
    (line,) = refused(dqn_main, monkeypatch, capsys, "--resume", str(stopped))
    assert line.endswith(f"{stopped} belongs to another learner; use gridsim-evolve --resume {stopped}")


def test_resume_refuses_damaged_checkpoints(stopped, monkeypatch, capsys):
    path = stopped / "checkpoint.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    (line,) = refused(evolve_main, monkeypatch, capsys, "--resume", str(stopped))
    assert "checkpoint.npz: truncated" in line
    assert line.endswith(f"; start it anew with --config {stopped}/config.json")
    path.write_bytes(whole)
    config = json.loads((stopped / "config.json").read_text())
    config["settings"]["seed"] = 99
    (stopped / "config.json").write_text(json.dumps(config))
    (line,) = refused(evolve_main, monkeypatch, capsys, "--resume", str(stopped))
    assert "do not belong together: one of them was edited, or another version of GridSim wrote them" in line


def test_a_device_that_is_not_there_is_said(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    (line,) = refused(dqn_main, monkeypatch, capsys, "--workers", "0", "--device", "cuda")
    assert "--device cuda: PyTorch finds no device" in line


def test_a_champion_that_does_not_fit_is_refused(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for policy, gene, said in (
        ("mlp:6,7", 0.0, "is a mlp:6,7; use --policy mlp:6,7"),
        ("mlp:64+steering", np.nan, "some of its genes are not numbers"),
    ):
        genes = np.full(PolicySpec.parse(policy).size, gene, dtype=np.float32)
        Champion(genes, policy, "curved", SimConfig()).save("c.npz")
        (line,) = refused(evolve_main, monkeypatch, capsys, "--workers", "0", "--init", "c.npz")
        assert said in line


def test_config_of_a_run_that_began_with_a_champion_begins_with_it_again(monkeypatch, capsys, tmp_path):
    RunFolder(tmp_path, EvolveSettings("curved"), init=str(tmp_path / "gone.npz")).write_config()
    (line,) = refused(evolve_main, monkeypatch, capsys, "--workers", "0", "--config", str(tmp_path / "config.json"))
    assert "gone.npz" in line


@pytest.mark.parametrize("main", [evolve_main, compare_main])
def test_a_folder_that_another_process_works_on_is_refused_in_one_line(main, monkeypatch, capsys, tmp_path):
    RunFolder(tmp_path, EvolveSettings("curved")).write_config()
    ComparisonFolder(tmp_path, Plan(("curved",), ("dqn",), 1, budget="1k")).write()
    hold = f"from cluster.store.folder import lock, Path; lock(Path({str(tmp_path)!r})); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout
        other.stdout.readline()
        (line,) = refused(main, monkeypatch, capsys, "--resume", str(tmp_path))
        assert line.endswith(f"{tmp_path}: another process is at work on it; wait for it, or stop it")
        other.communicate(b"\n")
    (line,) = refused(evolve_main, monkeypatch, capsys, "--resume", str(tmp_path))
    assert "has no checkpoint.npz" in line
