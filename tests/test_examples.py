"""The programs in examples/ do what they say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.e2e
def test_ppo_learns_to_drive(root: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(root / "examples" / "ppo.py"), "--scenario", "curved", "--minutes", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    success = [float(share) for share in re.findall(r"success of the last \d+ episodes +([\d.]+)%", done.stdout)]
    assert success[0] < 5.0, done.stdout
    assert success[-1] > 10.0, done.stdout
