"""A fitness of the user's own: by name and from Python, in runs that are kept and continued; faults in one line."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refused

import gridsim
from cluster import fitness
from cluster.commands.cli import evolve_main
from gridsim.errors import GridSimError

SMALL: dict[str, Any] = {"scenario": "curved", "population": 32, "generations": 2, "seed": 3}
OWN = """
import numpy as np

def early(results, targets):
    return -results["steps"].mean(axis=1)

def wrong(results, targets):
    return results["nothing"]

def unknown(results, targets):
    return np.where(np.arange(len(results)) == 1, np.nan, 0.0)

def shape(results, targets):
    return results["distance"]

number = 3
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A module of the user's, in the working folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)
    fitness.forget()
    return tmp_path / "own.py"


def early(results: np.ndarray, targets: Any) -> np.ndarray:
    return -results["steps"].mean(axis=1)


@pytest.mark.parametrize("name", ["own.py:early", "own:early"])
def test_it_is_found_by_name_and_decides_as_one_from_python_does(own: Path, name: str) -> None:
    wanted, history = gridsim.evolve(fitness=early, **SMALL)
    named, _ = gridsim.evolve(fitness=name, **SMALL)
    assert named.sha256 == wanted.sha256 != gridsim.evolve(**SMALL)[0].sha256
    assert history[-1]["fitness/best"] < 0.0


def test_a_file_that_was_changed_is_run_again(own: Path) -> None:
    first, _ = gridsim.evolve(fitness="own.py:early", **SMALL)
    own.write_text(OWN.replace('-results["steps"]', 'results["steps"]'))
    assert gridsim.evolve(fitness="own.py:early", **SMALL)[0].sha256 != first.sha256


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("own.py:wrong", r"own.py:wrong: own.py:8: ValueError: no field of name nothing$"),
        ("own:unknown", r"own:unknown: own.py:10 returned nan for member 1$"),
        ("own:shape", r"own:shape: own.py:13 returned an array of shape \[32, 1\], not one number per member, \[32\]$"),
        ("own:number", "number is not a function$"),
        ("own:nobody", "there is no nobody in own$"),
        ("own", "give MODULE:FUNCTION or FILE.py:FUNCTION$"),
        ("none.py:f", "none.py:f cannot be imported: FileNotFoundError"),
        ("none:f", "none:f cannot be imported: ModuleNotFoundError: No module named 'none'$"),
        ("broken:f", r"broken.py:2: SyntaxError: "),
    ],
)
def test_its_faults_are_said_with_file_and_line(own: Path, name: str, said: str) -> None:
    own.with_name("broken.py").write_text("x = 1\ndef f(:\n")
    with pytest.raises(GridSimError, match=f"^--fitness .*{said}") as caught:
        gridsim.evolve(gridsim.EvolveSettings(fitness=name, **SMALL))
    assert "\n" not in str(caught.value)


def test_a_run_is_kept_continued_and_refused_if_its_source_has_changed(
    own: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def run(generations: int, folder: str, **more: Any) -> Any:
        settings = gridsim.EvolveSettings(**SMALL | {"generations": generations}, fitness="own.py:early")
        return gridsim.evolve(settings, folder=folder, **more)

    run(2, "runs/r")
    steps = list[int]()
    driver, history = run(4, "runs/r", resume=True, on_generation=lambda done, row: steps.append(done))
    wanted, rows = run(4, "runs/whole")
    assert (driver.sha256, steps) == (wanted.sha256, [3, 4])
    assert [row["fitness/mean"] for row in history] == [row["fitness/mean"] for row in rows]
    assert run(4, "runs/r", resume=True)[1] == history, "it is finished"
    config = json.loads(Path("runs/r/config.json").read_text())
    assert config["settings"]["fitness"] == f"{own}:early"
    resume = ("--resume", "runs/r", "--generations", "9")
    (line,) = refused(evolve_main, monkeypatch, capsys, *resume)
    assert line.endswith(f"whose code runs only if you name it; give --fitness {own}:early again")
    with pytest.raises(GridSimError, match="is a run with other settings; give those, or another folder"):
        gridsim.evolve(folder="runs/r", resume=True, **SMALL)
    with pytest.raises(GridSimError, match="runs/r exists already"):
        gridsim.evolve(folder="runs/r", **SMALL)
    own.write_text(OWN + "\n")
    (line,) = refused(evolve_main, monkeypatch, capsys, *resume, "--fitness", "own.py:early")
    assert line.endswith("own.py:early is not what it was as runs/r began; put it back, or start a new run")
