"""What travels to an existing cluster with a run: this project's packages, so that its nodes need not have them.

A worker then runs the very sources that the coordinator runs, whatever else is installed beside it. Its node needs
Ray, NumPy, Numba and SciPy (PyTorch where the network is a `cnn`), in the coordinator's versions.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cluster
import evolution
import gridsim

PACKAGES = (cluster, evolution, gridsim)

#: Read by Ray when it connects. A job that was submitted with files of its own keeps them beside ours.
ENVIRONMENT = {"RAY_OVERRIDE_JOB_RUNTIME_ENV": "1"}


def runtime_env() -> dict[str, Any]:
    """Ray's `runtime_env` of a run's workers: some 200 KB that each node fetches once."""
    submitted = json.loads(os.environ.get("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")).get("runtime_env") or {}
    ours = [str(Path(package.__path__[0])) for package in PACKAGES]
    return {"py_modules": [*ours, *submitted.get("py_modules", [])], "excludes": ["__pycache__"]}
