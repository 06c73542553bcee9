"""Commands: flags, their defaults and bounds, help, versions, cores of this machine, and the live lines of a run."""

import dataclasses
import io
import re
import sys
import time
from dataclasses import asdict, replace
from importlib.metadata import entry_points, version

import pytest
from commands import start
from rich.console import Console

from cluster.commands import common as command
from cluster.commands import progress
from cluster.commands.cli import DqnFlags, EvaluateFlags, EvolveFlags
from cluster.commands.common import command_path, parse, warn_of_many_workers
from cluster.commands.compare import CompareFlags
from cluster.commands.progress import RunDisplay
from cluster.commands.watch import DriveFlags, WatchFlags
from cluster.learn.learning import Event
from cluster.settings import DqnSettings, EvolveSettings, from_dict
from cluster.workers import cores as module
from cluster.workers.cores import cores
from gridsim.errors import GridSimError

KINDS = (EvolveFlags, DqnFlags, EvaluateFlags, WatchFlags, DriveFlags, CompareFlags)
FLAGS = {f"gridsim-{kind.__name__.removesuffix('Flags').lower()}": kind for kind in KINDS}


@pytest.mark.parametrize("prog", FLAGS)
def test_help_fills_its_lines_has_an_example_and_says_in_words_what_happens_by_default(prog, monkeypatch, capsys):
    shown = {}
    for columns in (80, 1000):
        monkeypatch.setenv("COLUMNS", str(columns))
        with pytest.raises(SystemExit):
            parse(FLAGS[prog], prog, ["--help"])
        shown[columns] = capsys.readouterr().out
    lines = shown[80].splitlines()
    without_flag = {"gridsim-watch": " SOURCE [BESIDE]", "gridsim-evaluate": " CHAMPION", "gridsim-compare": " [RUNS]"}
    assert lines[0] == f"usage: {prog} [-h] [OPTIONS]{without_flag.get(prog, '')}"
    assert 72 <= max(map(len, lines)) <= 80
    assert f"Example: {prog} " in shown[1000]
    defaults = dict(re.findall(r"--(\w[\w-]*) (?:(?! --\w)[^\n])*\(default: (.*?)\)", shown[1000]))
    assert len(defaults) >= 2
    for group in ("learning", "work", "run") if prog in ("gridsim-evolve", "gridsim-dqn") else ():
        assert f" {group} options " in shown[1000]
    assert {name for name, default in defaults.items() if default in ("-1", "0", "0.0", "''", "None")} <= {"seed"}


@pytest.mark.parametrize(
    ("prog", "line", "said"),
    [
        ("gridsim-evolve", "--sede 3", "unrecognized --sede; did you mean --seed?"),
        ("gridsim-evolve", "--mutation_rat=0.1", "unrecognized --mutation-rat; did you mean --mutation-rate?"),
        ("gridsim-evaluate", "--josn runs/x", "unrecognized --josn; did you mean --json?"),
        ("gridsim-dqn", "--frobnicate", "unrecognized --frobnicate"),
        ("gridsim-evolve", "stray", "Unrecognized options: stray"),
        ("gridsim-evolve", "--population 2.5", "--population: '2.5' is not a whole number"),
        ("gridsim-evolve", "--until soon", "--until: could not convert string to float: 'soon'"),
        ("gridsim-evaluate", "--json", "Missing from gridsim-evaluate: CHAMPION A champion.npz, or a run's folder."),
    ],
)
def test_a_wrong_flag_is_told_in_one_line_on_a_terminal_too(prog, line, said, monkeypatch, capsys):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    with pytest.raises(SystemExit, match=r"^2$"):
        parse(FLAGS[prog], prog, line.split())
    first, second = capsys.readouterr().err.splitlines()
    assert first.removesuffix(" (required)") == f"{prog}: error: {said}"
    assert second == f"see {prog} --help"


@pytest.mark.parametrize(("written", "meant"), [("1e6", 10**6), ("1.5e3", 1500), ("1_000_000", 10**6), ("7", 7)])
def test_a_whole_number_may_be_written_with_an_exponent_or_underscores(written, meant):
    assert parse(EvolveFlags, "gridsim-evolve", ["--car-steps", written]).learning.car_steps == meant
    assert parse(WatchFlags, "gridsim-watch", ["runs/x", f"--generation={written}"]).generation == meant
    assert not parse(EvaluateFlags, "gridsim-evaluate", ["runs/x", "--json", "--no-json"]).json


@pytest.mark.parametrize("prog", ["gridsim-evolve", "gridsim-drive"])  # more and less than a pipe's buffer holds
def test_help_into_head_ends_quietly(prog, tmp_path):
    with start(prog, "--help", cwd=tmp_path) as shown:
        shown.stdout.close()
        assert (shown.stderr.read(), shown.wait()) == ("", 0)
    assert list(tmp_path.iterdir()) == []


def test_a_command_is_called_as_this_one_was(here, monkeypatch):
    folder = here / "venv/bin"
    folder.mkdir(parents=True)
    (folder / "gridsim-watch").touch()
    for called, path, other in (
        ("venv/bin/gridsim-evolve", "/bin", "venv/bin/gridsim-watch"),
        ("venv/bin/gridsim-evolve", f"/bin:{folder}", "gridsim-watch"),
        ("-c", "/bin", "gridsim-watch"),
    ):
        monkeypatch.setattr(sys, "argv", [called])
        monkeypatch.setenv("PATH", path)
        assert command_path("gridsim-watch") == other


@pytest.mark.parametrize("prog", FLAGS)
def test_each_command_tells_its_version(prog, monkeypatch, capsys):
    (script,) = entry_points(group="console_scripts", name=prog)
    monkeypatch.setattr(sys, "argv", [prog, "--version"])
    script.load()()
    assert capsys.readouterr() == (f"gridsim {version('gridsim-driving')}\n", "")


def test_more_workers_than_cores_can_use_are_told_of(monkeypatch, capsys):
    monkeypatch.setattr(command, "cores", lambda: 2)
    for workers, address in ((4, ""), (1000, "head:6379")):
        warn_of_many_workers("gridsim-compare", workers, address)
    assert capsys.readouterr().err == ""
    warn_of_many_workers("gridsim-evolve", 1000, None)
    assert capsys.readouterr().err.startswith("gridsim-evolve: warning: 1,000 workers on 2 cores")


# --- Settings --------------------------------------------------------------------------------------------------------

POLICIES = {
    "mlp:64+steering": EvolveSettings("city", traffic=0),
    "mlp:128+motion+steering": EvolveSettings("curved", traffic=2),
    "cnn:8,16,32@1": EvolveSettings("city", observation="grid"),
    "mlp:5": EvolveSettings("city", policy="mlp:5"),
    "mlp:64+steering+continuous": EvolveSettings(actions="continuous"),
    "mlp:5+motion+continuous": EvolveSettings(policy="mlp:5+motion+continuous", actions="continuous"),
    "cnn:8,16,32@1+continuous": EvolveSettings(observation="grid", actions="continuous"),
    "cnn:16,32,256@4": DqnSettings(observation="grid", batch=32),
}


@pytest.mark.parametrize(("policy", "settings"), POLICIES.items())
def test_the_policy_suits_observation_and_traffic(policy, settings):
    settings.check()
    assert settings.policy == policy
    assert from_dict(type(settings), asdict(settings)) == settings


def test_evolution_s_default_budget_is_of_car_steps():
    usual, short = EvolveSettings(), EvolveSettings(generations=4)
    assert (usual.generations, usual.car_steps) == (0, 60_000_000)
    assert (short.generations, short.car_steps) == (4, 0)  # whoever says how long means it
    assert usual.ended({"solved": False, "generation": 1, "car_steps": 60_000_000})
    assert not usual.ended({"solved": False, "generation": 10**9, "car_steps": 29_999_999})
    assert usual.ended({"solved": True, "generation": 0, "car_steps": 0})
    assert short.ended({"solved": False, "generation": 4, "car_steps": 0})
    assert not short.ended({"solved": False, "generation": 3, "car_steps": 10**12})


def test_more_generations_of_a_run_of_the_default_budget_are_not_cut_short_by_it():
    usual, short = EvolveSettings("city", seed=3), EvolveSettings(generations=9, car_steps=100)
    assert replace(usual, generations=500).extending(usual) == EvolveSettings("city", seed=3, generations=500)
    assert usual.extending(usual) == usual
    assert replace(short, generations=10).extending(short) == EvolveSettings(generations=10, car_steps=100)


@pytest.mark.parametrize(("population", "groups"), [(4, 1), (31, 1), (32, 2), (127, 7), (1000, 8)])
def test_there_are_no_more_groups_than_members_for_them(population, groups):
    settings = EvolveSettings(population=population)
    settings.check()
    assert settings.curriculum().groups == settings.search_config().groups == groups


@pytest.mark.parametrize(
    ("kind", "wrong", "said"),
    [
        (EvolveSettings, {"observation": "grid", "policy": "mlp:5"}, "policy mlp:5 sees the rays.*--observation rays"),
        (EvolveSettings, {"policy": "mlp:5+continuous"}, "policy mlp:5.continuous .* give --actions continuous, too"),
        (EvolveSettings, {"actions": "both"}, "--actions must be discrete or continuous, not both"),
        (DqnSettings, {"policy": "mlp:5+continuous"}, "the DQN chooses among the eight actions; leave out .continuous"),
        (EvolveSettings, {"elites": 4}, "--elites is for --recombination two"),
        (EvolveSettings, {"recombination": "two", "mutation_rate": 1.5}, "--mutation-rate must be 0 to 1"),
        (EvolveSettings, {"tournament": 0}, "--tournament must be 1 to"),
        (EvolveSettings, {"sigma": float("nan")}, "--sigma must be above 0"),
        (DqnSettings, {"discount": 1.5}, "--discount must be 0 to 1, not 1.5"),
        (DqnSettings, {"replay": 10}, "--replay must be 256 to 10,000,000, not 10"),
        (EvolveSettings, {"observation": "pixels"}, "--observation must be rays or grid, not pixels"),
        (EvolveSettings, {"population": True}, "must be int"),
        (EvolveSettings, {"crossover": 1}, "^unknown setting 'crossover', perhaps of another version of GridSim"),
        (DqnSettings, {"anneal": 10**400}, "--anneal must be 1 to 1,000,000,000,000,000"),
    ],
)
def test_settings_that_make_no_sense_are_refused_in_one_line(kind, wrong, said):
    with pytest.raises(GridSimError, match=rf"^[^\n]*{said}[^\n]*$"):
        from_dict(kind, asdict(kind()) | wrong)


# --- Cores -----------------------------------------------------------------------------------------------------------


V1 = "9:name=systemd:/\n4:cpu,cpuacct:/kubepods/pod1\n3:cpuset:/\n"


@pytest.mark.parametrize(
    ("groups", "files", "count"),
    [
        ("0::/\n", {"cpu.max": "max 100000"}, 8),
        ("0::/\n", {"cpu.max": "250000 100000"}, 3),
        ("0::/\n", {"cpu.max": "50000 100000"}, 1),
        ("0::/\n", {"cpu.max": "6400000 100000"}, 8),
        # CPUQuota of a service, and of the slice it is in, as the host sees them.
        ("0::/a.slice/b.service\n", {"a.slice/cpu.max": "200000 100000", "a.slice/b.service/cpu.max": "max 1"}, 2),
        # The path on the host, which is not in the container.
        ("0::/docker/abc\n", {"cpu.max": "200000 100000"}, 2),
        (V1, {"cpu/kubepods/pod1/cpu.cfs_quota_us": "100000", "cpu/kubepods/pod1/cpu.cfs_period_us": "100000"}, 1),
        (V1, {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
        ("0::/\n", {"cpu.max": "nonsense"}, 8),
        (None, {}, 8),
    ],
)  # fmt: skip
def test_the_quota_of_a_container_counts(groups, files, count, tmp_path, monkeypatch):
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    if groups is not None:
        (tmp_path / "proc/self").mkdir(parents=True)
        (tmp_path / "proc/self/cgroup").write_text(groups)
    for name, content in files.items():
        file = tmp_path / "sys/fs/cgroup" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{content}\n")
    assert cores(tmp_path) == count


# --- Live lines ------------------------------------------------------------------------------------------------------

ROW = {
    "validation/success_rate": 0.37, "car_steps_per_s": 1_234_567.0, "car_steps": 12_300_000.0, "distance_m/best": 1812,
    "distance_m/mean": 1300.0, "target_m": 2000.0, "speed_mps/best": 7.1,
}  # fmt: skip
BY_CAR_STEPS, BY_GENERATIONS = EvolveSettings("curved", car_steps=30_000_000), EvolveSettings("curved", generations=480)


def display(settings, width=120, terminal=True):
    return RunDisplay(Console(width=width, force_terminal=terminal, color_system=None, file=io.StringIO()), settings)


def drawn(shown):
    console = Console(width=shown.console.width, force_terminal=True, color_system=None, file=io.StringIO())
    lines = ["".join(segment.text for segment in line) for line in console.render_lines(shown.text(), pad=False)]
    assert len(lines) == 2 + shown.rest.count("\n")  # none is wrapped
    assert max(map(len, lines)) <= console.width
    return "\n".join(lines)


def after(monkeypatch, seconds):
    now = time.perf_counter()
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now + seconds)


@pytest.mark.parametrize("width", [60, 80, 120])
@pytest.mark.parametrize(
    ("settings", "counters"),
    [
        (BY_CAR_STEPS, ["12.3/30 M car-steps", "18.4/30 M car-steps", "30.0/30 M car-steps"]),
        (BY_GENERATIONS, ["240/480 generations", "360/480 generations", "480/480 generations"]),
    ],
)
def test_counter_success_and_until_the_limit_is_reached_an_eta_are_always_there(settings, counters, width, monkeypatch):
    shown = display(settings, width)
    shown.event(Event("starting the workers"))
    assert drawn(shown).endswith("\nstarting the workers")
    shown.row(240, ROW)
    assert drawn(shown).startswith(f"{counters[0]}  success 37%  ETA -:--  ━━")
    after(monkeypatch, 3700.0)
    shown.row(360, {**ROW, "car_steps": 12_300_000.0 * 1.5})
    shown.event(Event("evolve", 3, 128))
    assert drawn(shown).startswith(f"{counters[1]}  success 37%  ETA 1:")
    assert " at most  " in drawn(shown)
    assert "\nevolve   3/128  " in drawn(shown)
    shown.row(481, {**ROW, "car_steps": 31_000_000.0})
    assert drawn(shown).startswith(f"{counters[2]}  success 37%  ━")


def test_without_a_terminal_there_are_lines_and_no_eta_before_it_means_something(monkeypatch, capsys):
    """The first step takes as long as all that is started for it."""
    shown = display(BY_CAR_STEPS, terminal=False)
    shown.event(Event("compiling the simulator"))
    shown.event(Event("evolve", 1, 2))
    shown.event(Event("a worker is replaced", warning=True))
    assert shown.console.file.getvalue() == "compiling the simulator\n"
    assert capsys.readouterr().err == "gridsim-evolve: warning: a worker is replaced\n"
    after(monkeypatch, 60.0)
    shown.row(1, {**ROW, "car_steps_per_s": 500.0, "car_steps": 300_000.0})
    after(monkeypatch, 1.0)
    shown.row(2, {**ROW, "car_steps": 1_300_000.0})
    assert "ETA -:--" in drawn(shown)
    after(monkeypatch, 10.5)
    shown.row(3, {**ROW, "car_steps": 4_000_000.0})
    assert "ETA 1:" in drawn(shown)
    driven = "1 generation  distance 1,812 m best, 1,300 mean of 2,000  7.1"
    assert f"\n0.3/30 M car-steps  success 37%  ETA -:--  {driven}" in shown.console.file.getvalue()


def test_each_learners_rows_are_said_in_words():
    assert progress.row_in_words(BY_GENERATIONS, 2, ROW) == "distance 1,812 m best, 1,300 mean of 2,000  7.1 m/s"
    row = {**ROW, "loss": 0.0123, "network/success_rate": 0.5, "updates": 1500.0, "episodes": 1e4}
    dqn = DqnSettings("curved", car_steps=0, episodes=20_000)
    assert progress.row_in_words(dqn, 2, row) == "distance 1,812 m, 50% succeed  7.1 m/s  loss 0.012  2 k updates"
    assert progress.progress(dqn, 2, row) == (0.5, "10000/20000 episodes")
    both = EvolveSettings("curved", car_steps=30_000_000, generations=10**15)
    assert progress.progress(both, 2, ROW)[1] == "12.3/30 M car-steps"
    assert progress.progress(dataclasses.replace(both, car_steps=0), 2, ROW) == (0.0, "2 generations")


def test_a_terminal_shows_it_live():
    with display(BY_GENERATIONS, 60) as shown:
        shown.head, shown.facts, shown.rest = "12/30 generations", "success 37%", "240 generations\nmore"
    assert "12/30 generations  success 37%  ━━━━━━━━━━  0:00\n240 generations\nmore" in shown.console.file.getvalue()
