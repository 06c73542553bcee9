"""What the tests share: the checkout's root, a clean environment, and commands run as a user runs them."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sysconfig
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from gridsim.scenarios import Scenario

# Nothing may reach a cluster or a tracking server that the shell happens to name.
for _name in ("MLFLOW_TRACKING_URI", "MLFLOW_EXPERIMENT_NAME", "MLFLOW_RUN_ID", "RAY_ADDRESS"):
    os.environ.pop(_name, None)

# A shell ignores Ctrl-C for what it starts in the background, and so would the commands that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: an example that comes first may compile a kernel. CI's examples are the same in every run.
settings.register_profile("gridsim", settings.get_profile("ci" if os.environ.get("CI") else "default"), deadline=None)
settings.load_profile("gridsim")

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(autouse=True)
def _ctrl_c_as_before() -> Iterator[None]:
    """Commands inherit whether Ctrl-C is ignored: a test that leaves it so spoils later ones."""
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout's root folder."""
    return Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An MLflow database that has been created once, for tests to copy: creating one takes seconds."""
    from cluster.tracker import Tracker
    from cluster.tracking_address import check_uri

    folder = tmp_path_factory.mktemp("mlflow")
    begun = Tracker(check_uri(f"sqlite:///{folder}/mlflow.db"), "other", "other", {}, {})
    begun.wait_ready(60)
    assert begun.close("FINISHED") is None
    assert os.listdir(folder) == ["mlflow.db"]
    return folder / "mlflow.db"


@pytest.fixture
def uri(empty_database: Path, tmp_path: Path) -> str:
    """MLflow's address of a database that holds nothing but the experiment `other`."""
    from cluster.tracking_address import check_uri

    (tmp_path / "store").mkdir()
    shutil.copy(empty_database, tmp_path / "store" / "mlflow.db")
    return check_uri(f"sqlite:///{tmp_path}/store/mlflow.db")


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short pauses of a tracker."""
    from cluster import tracker, tracking_address

    monkeypatch.setattr(tracker, "FLUSH_S", 0.05)
    monkeypatch.setattr(tracker, "RETRY_S", 0.1)
    monkeypatch.setattr(tracker, "CHANCE_S", 0.1)
    monkeypatch.setattr(tracking_address, "PROBE_S", 0.3)


@pytest.fixture(scope="session")
def maps() -> dict[str, list[Scenario]]:
    """Two maps of each scenario."""
    from gridsim.scenarios import REGISTRY, build

    return {name: [build(name, seed) for seed in range(2)] for name in REGISTRY}


@pytest.fixture
def dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows that nobody sees."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def command(tmp_path: Path) -> Command:
    """Run an installed console script in the test's empty folder: `command("gridsim-evolve", "--seed", 1)`.

    Keywords but `timeout_s` are set in its environment. Nothing is asserted of how it ends.
    """

    def run(name: str, *arguments: object, timeout_s: float = 300, **environment: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            [Path(sysconfig.get_path("scripts")) / name, *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, **environment},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout_s,
        )

    return run
