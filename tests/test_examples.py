"""The programs in examples/ do what they say."""

import re
from pathlib import Path

import pytest
from commands import finish, running


@pytest.mark.e2e
def test_cma_es_learns_to_drive(root: Path, tmp_path: Path) -> None:
    pytest.importorskip("cma")
    done = finish("python", str(root / "examples/pycma.py"), "--minutes", "3", cwd=tmp_path)
    assert float(re.findall(r"roads (\d+)%", done.stdout)[-1]) > 50.0
    assert (tmp_path / "champion.npz").exists()


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
