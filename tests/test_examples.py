"""The programs in examples/ do what they say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.e2e
def test_ppo_learns_to_drive(root: Path, tmp_path: Path) -> None:
    """It is stopped once it drives: a minute where nothing else runs, four where ten other processes do."""
    command = [sys.executable, str(root / "examples" / "ppo.py"), "--scenario", "curved", "--minutes", "8"]
    success: list[float] = []
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as learner:
        assert learner.stdout is not None
        for line in learner.stdout:
            success += [float(share) for share in re.findall(r"episodes +([\d.]+)%", line)]
            if success[-1] > 50.0:
                break
        learner.kill()
    assert success[0] == 0.0
    assert success[-1] > 50.0
