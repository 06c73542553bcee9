"""Names that mean something to a shell, a terminal, HTML or Matplotlib: written as they are, and quoted in commands."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from html import unescape
from urllib.parse import unquote_to_bytes

import numpy as np
import pytest
from commands import BIN, CHAMPION, PATH, call, finish, refused
from finished_runs import make_run, with_errors
from pictures import small_map

from cluster.commands import compare
from cluster.commands.cli import dqn_main, evaluate_main, evolve_main
from cluster.commands.compare import compare_main
from cluster.commands.watch import watch_main
from cluster.report import pictures
from gridsim.state import CAR_FIELDS as FIELDS

ODD = "a  b ?#%;&'\"[b] $x (c)"


def shell(command, cwd):
    """Run a command that was printed to be pasted."""
    done = subprocess.run(["sh", "-c", command], cwd=cwd, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.e2e
@pytest.mark.usefixtures("database")
def test_commands_that_are_printed_can_be_pasted_in_folders_of_any_name(tmp_path):
    folder, scripts = tmp_path / ODD, tmp_path / "the scripts"
    folder.mkdir()
    scripts.mkdir()
    for name in ("gridsim-evolve", "gridsim-watch", "gridsim-compare", "mlflow"):
        (scripts / name).symlink_to(BIN / name)
    store = f"sqlite:///{tmp_path}/mlflow.db"
    asked = ["--workers", "0", "--population", "32", "--generations", "1", "--scenario", "curved", "--name", "one"]
    asked += ["--output=-x[/y]:smile:", "--tracking-uri", store]
    out = finish(scripts / "gridsim-evolve", *asked, cwd=folder).stdout
    run = folder / "-x[/y]:smile:/one"
    assert "curved, seed 0 -> './-x[/y]:smile:/one'\n" in out
    assert "run: './-x[/y]:smile:/one'   champion: './-x[/y]:smile:/one/champion.npz'\n" in out
    (again,) = re.findall("^to go on: (.*)$", out, flags=re.MULTILINE)
    assert "-> './-x[/y]:smile:/one'\n" in shell(f"{again} --workers 0 --tracking-uri {store}", folder)
    assert len((run / "history.csv").read_text().splitlines()) == 3
    (watch,) = re.findall("in a browser, or (.*)$", out, flags=re.MULTILINE)
    assert "x[y]:z.html: " in shell(f"{watch} --output 'x[y]:z.html' --seconds 1", folder)
    out = shell(f"'{scripts}'/gridsim-compare './-x[/y]:smile:/one' --output '[b]' --name c", folder)
    (report,) = re.findall("^tables, picture and drives: (.*)$", out, flags=re.MULTILINE)
    page = folder / shlex.split(report)[0]
    (link,) = re.findall('<a href="(.*?)">one</a>', page.read_text())
    assert os.path.samefile(os.fsencode(page.parent) + b"/" + unquote_to_bytes(unescape(link)), run / "drive.html")


@pytest.mark.parametrize(
    ("main", "arguments", "said", "path"),
    [
        (evolve_main, ["--output", "a  b", "--name", "run"], "exists already", "a  b/run"),
        (evolve_main, ["--output=-a", "--name", "run"], "exists already", "./-a/run"),
        (dqn_main, ["--resume", "a  b/run"], "has no checkpoint.npz", "a  b/run/config.json"),
        (watch_main, ["a  b/run"], "has no champion.npz yet", "a  b/run/config.json"),
        (compare_main, ["a  b/run"], "a  b/run is not finished", "a  b/run"),
    ],
)
def test_the_path_of_a_command_in_a_message_is_quoted(main, arguments, said, path, here, monkeypatch, capsys):
    for folder in ("a  b", "-a"):
        make_run(here / folder / "run")
        for name in ("champion.npz", "summary.json"):
            (here / folder / "run" / name).unlink()
    line, *_ = refused(main, monkeypatch, capsys, *arguments)
    assert said in line
    assert shlex.split(re.split("--(?:resume|config) ", line)[-1]) == [path]


def test_a_name_is_no_markup_and_its_spaces_stay(here, monkeypatch, capsys):
    (here / "x[").mkdir()
    shutil.copy(CHAMPION, here / "x[/b]:car:")
    code, out, _ = call(evaluate_main, monkeypatch, capsys, "x[/b]:car:", "--episodes", 1)
    assert (code, out.partition(" on ")[0]) == (0, "x[/b]:car:")
    assert "no  such is not a run's folder" in refused(evolve_main, monkeypatch, capsys, "--resume", "no  such")[0]


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (evolve_main, ["--output", "NAME"]),
        (evolve_main, ["--resume", "NAME"]),
        (watch_main, ["NAME"]),
        (watch_main, [CHAMPION, "--output", "NAME/drive.mp4"]),
        (compare_main, ["NAME"]),
        (compare_main, ["--resume", "NAME"]),
    ],
)
def test_a_name_that_is_too_long_is_told_in_one_line(main, arguments, here, monkeypatch, capsys):
    name = "ü" * 150  # 300 bytes
    line, *_ = refused(main, monkeypatch, capsys, *(str(each).replace("NAME", name) for each in arguments))
    assert f"{name}" in line
    assert line.endswith("File name too long")


@pytest.mark.e2e
@pytest.mark.parametrize("encoding", ["utf-8:strict", "ascii"])
def test_a_name_that_the_terminal_cannot_show_is_no_error(encoding, tmp_path):
    name = os.fsdecode(b"M\xfcller")  # in Latin-1
    shutil.copy(CHAMPION, tmp_path / name)
    done = subprocess.run(
        [BIN / "gridsim-evaluate", name, "--episodes", "1"],
        env=os.environ | {"PATH": PATH, "PYTHONIOENCODING": encoding}, cwd=tmp_path, capture_output=True, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.startswith(b"M\xfcller on " if encoding == "utf-8:strict" else rb"M\udcfcller on ")


@pytest.mark.skipif(sys.platform == "darwin", reason="its file names are UTF-8")
def test_names_of_any_bytes_are_drawn_and_compared(here, monkeypatch, capsys):
    name = os.fsdecode(b"M\xfcller $5 $x^ <b>")
    states = np.zeros((20, FIELDS), dtype=np.float32)
    pictures.trajectory(small_map([[0, 32, 64, 32, 4.0]]), states, here / "drive.png", f"{name} 漢")
    make_run(here / "run")
    (here / "run").rename(here / name)
    (here / name / "drive.html").touch()
    monkeypatch.setattr(compare, "measured", with_errors)
    assert call(compare_main, monkeypatch, capsys, name, "--name", "c")[0] == 0
    (link,) = re.findall(rb'<a href="(.*?)">', (here / "runs/c/comparison.html").read_bytes())
    assert unquote_to_bytes(unescape(link.decode())) == os.fsencode(f"../../{name}/drive.html")
    assert os.fsencode(name) in (here / "runs/c/table.csv").read_bytes()
