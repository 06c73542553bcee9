"""The commands as a user runs them: installed scripts, real Ray workers, real kills."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tracked
from commands import BIN, all_in_mlflow, descendants, finish, refused, rows, same_run, start, summary, wait_until

from cluster.commands.cli import dqn_main, evolve_main
from cluster.commands.compare import compare_main
from cluster.compare.plan import Plan, write_plan
from cluster.settings import EvolveSettings
from cluster.store.champion import Champion
from cluster.store.checkpoint import save
from cluster.store.folder import RunFolder
from evolution.networks.policy import PolicySpec
from gridsim.config import SimConfig

# Of all maps these are built fastest.
ROAD = ["--scenario", "curved", "--traffic", "2"]
GENERATIONS = 30  # some seconds: a run is saved once a second, and is to be met while it learns
SMALL = [*ROAD, "--population", "48", "--generations", str(GENERATIONS), "--seed", "5"]
REFERENCE = ("gridsim-evolve", *SMALL)


def evolve(*arguments, cwd):
    return finish("gridsim-evolve", *arguments, cwd=cwd)


PHASES = {  # what a run says, or leaves, as the phase begins
    "compiling": lambda out, run: "compiling the simulator" in out,
    "starting Ray": lambda out, run: "starting the workers" in out,
    "learning": lambda out, run: len(rows(run)) >= 2,
    "finishing": lambda out, run: (run / "champion.npz").exists(),
}


@pytest.mark.e2e
@pytest.mark.usefixtures("database", "audited")  # a run waits for MLflow no more than 15 s if there is a database
@pytest.mark.parametrize("workers", ["0", "2"])
def test_ctrl_c_in_every_phase_saves_and_leaves_nothing_behind(reference, tmp_path, workers):
    run = tmp_path / "runs/c"
    command = [BIN / "gridsim-evolve", "--workers", workers, "--name", "c", "--resume-if-exists", *SMALL]
    for phase, begun in PHASES.items():
        if workers == "0" and phase in ("compiling", "starting Ray"):  # no Ray; compiling is the same with workers
            continue
        log, early = tmp_path / f"{phase}.log", phase in ("compiling", "starting Ray")
        environment = os.environ | ({"GRIDSIM_CACHE_DIR": str(tmp_path / "cache")} if phase == "compiling" else {})
        with (
            log.open("w") as output,
            subprocess.Popen(
                command, cwd=tmp_path, env=environment, stdout=output, stderr=output, start_new_session=True
            ) as process,
        ):
            wait_until(lambda log=log, begun=begun: begun(log.read_text(), run))
            children, began = descendants(process.pid), time.monotonic()
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to every process
            code = process.wait(60)
            took_s = time.monotonic() - began
        wait_until(lambda children=children: not [c for c in children if Path(f"/proc/{c}").exists()], 30)
        out = log.read_text()
        assert code == 130, out
        assert took_s < 15
        assert "Traceback" not in out
        last = "no generation was done yet" if early else "gridsim-evolve --resume runs/c"
        assert out.splitlines()[-1].endswith(last)
        assert run.exists() != early
        assert phase != "learning" or len(rows(run)) < GENERATIONS
        if not early:
            found = tracked.runs(f"sqlite:///{tmp_path}/mlflow.db")
            assert [each.info.status for each in found if each.info.run_name == "c"] == ["KILLED"]
    evolve("--resume", "runs/c", cwd=tmp_path)
    assert same_run(run, reference)


@pytest.mark.e2e
@pytest.mark.usefixtures("database", "audited")
def test_a_run_goes_on_in_any_mode_after_a_kill_in_another(reference, cluster, tmp_path):
    run, command = tmp_path / "runs/k", ["gridsim-evolve", *SMALL, "--name", "k", "--resume-if-exists"]
    address = {"RAY_ADDRESS": cluster(1)}
    for place in ("--workers 1", "--workers 0 --address local", "--address auto", "--workers 2"):
        env, before = address if "--address" in place else {}, len(rows(run))
        with start(*command, *place.split(), cwd=tmp_path, **env) as process:
            wait_until(lambda before=before: len(rows(run)) > before)
            process.kill()
        assert len(rows(run)) < GENERATIONS, f"nothing was left to do after {place}"
    evolve("--resume", "runs/k", cwd=tmp_path)
    assert same_run(run, reference)


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_start_or_continue_in_one_flag(reference, tmp_path):
    """A job that a cluster starts again goes on; of two at once one is refused; a finished one says so."""
    command = ("gridsim-evolve", *SMALL, "--name", "r", "--resume-if-exists")
    with start(*command, cwd=tmp_path) as first, start(*command, cwd=tmp_path) as second:
        out, codes = [], []
        for process in (first, second):
            out.append(process.communicate(timeout=120))
            codes.append(process.returncode)
    assert sorted(codes) == [0, 2]
    refusal = out[codes.index(2)][1]
    assert "another process is at work on it" in refusal or "another process has just begun this run" in refusal
    assert same_run(tmp_path / "runs/r", reference)
    assert "runs/r is finished" in evolve(*command[1:], cwd=tmp_path).stdout
    for name in ("checkpoint.npz", "steps.bin", "history.csv", *(p.name for p in reference.glob("*.png"))):
        (tmp_path / "runs/r" / name).unlink()
    others = [path.name for path in (tmp_path / "runs/r").iterdir() if path.name not in ("config.json", "mlflow.json")]
    done = finish(*command, cwd=tmp_path, code=2)
    assert "exists already" in done.stderr, "it has files of a run, but no checkpoint"
    for name in others:
        (tmp_path / "runs/r" / name).unlink()
    evolve(*command[1:], cwd=tmp_path)
    assert same_run(tmp_path / "runs/r", reference)


@pytest.mark.e2e
def test_run_folder_and_mlflow_keep_their_contracts(reference):
    home = reference.parent.parent
    stored = {path.name: path.read_bytes() for path in (home / "mlartifacts").rglob("*") if path.is_file()}
    names = ("config.json", "champion.npz", "elites.npz", "steps.bin", "curves.png", "trajectory.png", "drive.html")
    for name in names:
        assert stored[name] == (reference / name).read_bytes() > b""
    assert (reference / "checkpoint.npz").is_file()
    figures = summary(reference)
    assert len(rows(reference)) == figures["generations"] == GENERATIONS
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
    evolve("--config", config, "--generations", "20", "--name", "s", cwd=tmp_path)
    assert "finished" in evolve("--resume", "runs/s", cwd=tmp_path).stdout
    done = evolve("--resume", "runs/s", "--generations", str(GENERATIONS), cwd=tmp_path)
    assert same_run(run, reference)
    assert "compare: make ui, or" in done.stdout
    assert "% (in MLflow validation/success_rate; the table's is held_out/success_rate)" in done.stdout
    assert f"--resume runs/s --generations {2 * GENERATIONS}\n" in done.stdout


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_init_begins_with_a_champion(reference, tmp_path):
    small = ["--population", "24", "--generations", "1", "--recombination", "two", "--mutation-rate", "0"]
    evolve(*ROAD, *small, "--init", str(reference), "--name", "warm", cwd=tmp_path)
    # Without mutation every member is the one it started from.
    assert summary(tmp_path / "runs/warm")["champion_sha256"] == summary(reference)["champion_sha256"]


WRONG = [
    ("--scenario moon", "unknown scenario"),
    ("--sim f1tent", "unknown simulator 'f1tent'; did you mean f1tenth?"),
    ("--sim none.yaml", "none.yaml: No such file"),
    ("--sim f1tenth --scenario city --traffic 3", "traffic is for cars of 2.83 m or more"),
    ("--workers -1", "--workers"),
    ("--patience -1", "--patience must be 0 or more"),
    ("--output /proc/nowhere", "--output"),
    ("--name ../up", "--name"),
    ("--resume nowhere", "nowhere is not a run's folder"),
    ("--config /etc/hostname", "config.json"),
    ("--init nothing.npz", "nothing.npz: cannot be read: No such file"),
    ("--wall-time -1", "--wall-time must be 0 or more"),
    ("--resume-if-exists", "give that, and no --resume"),
    ("--address 127.0.0.1:1", "127.0.0.1:1"),
    ("--tracking-uri http://127.0.0.1:1", "127.0.0.1:1: Connection refused; start one"),
    ("--init MADE/c.npz", "is a mlp:6,7; use --policy mlp:6,7"),
    ("--init MADE/c.npz --policy mlp:6,7 --actions continuous", "has discrete actions, this run continuous ones"),
    ("--policy mlp:6,7+continuous --device cpu", "the DQN chooses among the eight actions"),
    ("--config MADE/config.json", "gone.npz"),
    ("--config MADE/other/config.json", "c.npz is not what it was for"),
    ("--device cuda", "PyTorch finds no device 'cuda' here; use --device cpu"),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a champion, and the configuration of a run that began with one that is gone."""
    folder, genes = tmp_path_factory.mktemp("made"), np.zeros(PolicySpec.parse("mlp:6,7").size, dtype=np.float32)
    Champion(genes, "mlp:6,7", "curved", SimConfig()).save(folder / "c.npz")
    RunFolder(folder, EvolveSettings("curved"), init=str(folder / "gone.npz")).write_config()
    (folder / "other").mkdir()
    small = EvolveSettings("curved", policy="mlp:6,7")
    RunFolder(folder / "other", small, init=str(folder / "c.npz"), init_sha256="0").write_config()
    return folder


@pytest.mark.parametrize(("arguments", "expected"), WRONG)
def test_wrong_use_is_one_clear_line(made, arguments, expected, monkeypatch, capsys, here):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    main = dqn_main if "--device" in arguments else evolve_main
    assert expected in refused(main, monkeypatch, capsys, *arguments.replace("MADE", str(made)).split())[0]
    assert list(here.iterdir()) == []  # nothing half-written


@pytest.mark.parametrize(("flag", "path"), [("--resume", "old"), ("--config", "old/config.json")])
def test_a_run_of_the_version_before_is_refused_in_one_line(flag, path, monkeypatch, capsys, here):
    folder = here / "old"
    folder.mkdir()
    for form in (1, 2):
        config = {"format": form, "command": "gridsim-evolve", "settings": {"scenario": "curved"}}
        (folder / "config.json").write_text(json.dumps(config))
        (line,) = refused(evolve_main, monkeypatch, capsys, flag, path)
        assert "old/config.json is of another GridSim, whose runs this one cannot continue; start a new run" in line
        assert (os.listdir(here), os.listdir(folder)) == (["old"], ["config.json"])


@pytest.fixture
def stopped(tmp_path):
    """The folder of a run that was stopped."""
    run = RunFolder(tmp_path / "r", EvolveSettings("curved", population=48, generations=6, seed=5))
    run.path.mkdir()
    run.write_config()
    save(run.path / "checkpoint.npz", {}, {"generation": 3, "car_steps": 9, "solved": False, "digest": run.digest()})
    return run.path


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("--actions continuous", "contradicts the run's mlp:64+steering; leave it out, or start a new run"),
        ("--seed 6", "--seed 6 contradicts the run's 5; leave it out, or start a new run"),
        ("--generations 2", "--generations 2 contradicts the run's 6; give a greater --generations, or start a new"),
        ("--car-steps 1e6", "--car-steps 1000000 is a new limit for the run; give a greater --generations"),
        ("--output elsewhere", "contradicts the run's"),
        ("--config r/config.json", "--resume and --config exclude each other"),
        ("--generations 9 --tracking-uri ftp://x", "not a tracking address"),  # no contradiction
    ],
)
def test_resume_refuses_contradictions(stopped, change, said, monkeypatch, capsys):
    monkeypatch.chdir(stopped.parent)
    (line,) = refused(evolve_main, monkeypatch, capsys, "--resume", "r", *change.split())
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


@pytest.mark.parametrize("main", [evolve_main, compare_main])
def test_a_folder_that_another_process_works_on_is_refused_in_one_line(main, monkeypatch, capsys, tmp_path):
    RunFolder(tmp_path, EvolveSettings("curved")).write_config()
    write_plan(tmp_path, Plan(("curved",), ("dqn",), 1, budget="1k"))
    hold = f"from cluster.store.folder import lock, Path; lock(Path({str(tmp_path)!r})); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout
        other.stdout.readline()
        (line,) = refused(main, monkeypatch, capsys, "--resume", str(tmp_path))
        assert line.endswith(f"{tmp_path}: another process is at work on it; wait for it, or stop it")
        other.communicate(b"\n")
    (line,) = refused(evolve_main, monkeypatch, capsys, "--resume", str(tmp_path))
    assert "has no checkpoint.npz" in line
