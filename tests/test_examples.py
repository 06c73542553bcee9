"""The programs in examples/ do what they say."""

import re
from pathlib import Path

import pytest
from commands import finish, running

import gridsim


@pytest.mark.e2e
def test_cma_es_learns_to_drive(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("cma")
    done = finish("python", str(root / "examples/pycma.py"), "--minutes", "3", cwd=tmp_path)
    assert float(re.findall(r"roads (\d+)%", done.stdout)[-1]) > 50.0
    assert (tmp_path / "champion.npz").exists()


@pytest.mark.e2e
def test_map_elites_makes_an_atlas_of_drivers(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("ribs")
    command = ("python", str(root / "examples/map_elites.py"), "--generations", "20")
    first, second = re.findall(r"^generation \d+: ([\d.]+) of 100", finish(*command, cwd=tmp_path).stdout, re.MULTILINE)
    assert 30.0 < float(second) > float(first)
    assert (tmp_path / "atlas/atlas.png").stat().st_size > 20_000
    drivers = sorted((tmp_path / "atlas").glob("*.npz"), key=lambda file: float(file.name.split("mps")[0]))
    slow, fast = (gridsim.evaluate(gridsim.load_champion(file), episodes=8) for file in (drivers[0], drivers[-1]))
    assert slow["speed_mps"] + 2.0 < fast["speed_mps"]


def test_the_search_finds_the_middle_of_a_sphere(root: Path, tmp_path: Path) -> None:
    output = finish("python", str(root / "examples/own_search.py"), cwd=tmp_path).stdout
    far = [float(metres) for metres in re.findall(r"^generation \d+: ([\d.]+)$", output, flags=re.MULTILINE)]
    assert far[0] > 0.5
    assert far == sorted(far, reverse=True)
    assert far[-1] < 0.01


@pytest.mark.e2e
def test_ppo_learns_to_drive(root: Path, tmp_path: Path) -> None:
    """It is stopped once it drives: a minute where nothing else runs, four where ten other processes do."""
    success: list[float] = []
    command = ("python", str(root / "examples/ppo.py"), "--scenario", "curved", "--minutes", "8")
    with running(*command, cwd=tmp_path) as learner:
        for line in learner.stdout:
            success += [float(share) for share in re.findall(r"episodes +([\d.]+)%", line)]
            if success[-1] > 50.0:
                break
    assert success[0] == 0.0
    assert success[-1] > 50.0
