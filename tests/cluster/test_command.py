"""What the commands share: their help, wrong flags, what they call each other, --version."""

import re
import sys
from importlib.metadata import entry_points, version

import pytest
from commands import start

from cluster.commands import common as command
from cluster.commands.cli import DqnFlags, EvaluateFlags, EvolveFlags
from cluster.commands.common import command_path, parse, warn_of_many_workers
from cluster.commands.compare import CompareFlags
from cluster.commands.watch import DriveFlags, WatchFlags

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
    defaults = dict(re.findall(r"--([\w-]+) .*\(default: (.*?)\)", shown[1000]))
    assert len(defaults) >= 2
    for group in ("learning", "work", "run") if prog in ("gridsim-evolve", "gridsim-dqn") else ():
        assert f" {group} options " in shown[1000]
    assert {name for name, default in defaults.items() if default in ("-1", "0", "0.0", "''", "None")} <= {"seed"}


def test_what_is_not_given_follows_from_what_is():
    assert not parse(EvaluateFlags, "gridsim-evaluate", ["runs/x", "--json", "--no-json"]).json
    learning = parse(EvolveFlags, "gridsim-evolve", ["--traffic", "2", "--generations", "5"]).learning
    assert (learning.policy, learning.population, learning.car_steps) == ("mlp:64+motion+steering", 128, 0)


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


@pytest.mark.parametrize("prog", ["gridsim-evolve", "gridsim-drive"])  # more and less than a pipe's buffer holds
def test_help_into_head_ends_quietly(prog, tmp_path):
    with start(prog, "--help", cwd=tmp_path) as shown:
        shown.stdout.close()
        assert (shown.stderr.read(), shown.wait()) == ("", 0)
    assert list(tmp_path.iterdir()) == []


def test_a_command_is_called_as_this_one_was(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "venv/bin"
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
    assert capsys.readouterr() == (f"gridsim {version('gridsim')}\n", "")


def test_more_workers_than_cores_can_use_are_told_of(monkeypatch, capsys):
    monkeypatch.setattr(command, "cores", lambda: 2)
    for workers, address in ((4, ""), (1000, "head:6379")):
        warn_of_many_workers("gridsim-compare", workers, address)
    assert capsys.readouterr().err == ""
    warn_of_many_workers("gridsim-evolve", 1000, None)
    assert capsys.readouterr().err.startswith("gridsim-evolve: warning: 1,000 workers on 2 cores")
