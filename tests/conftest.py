"""What the tests share: the checkout's root, a clean environment, and commands run as a user runs them."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from commands import BIN, answers, end, finish, wait_until
from hypothesis import settings

# Tests take nothing from the machine's home (a cluster's token) or shell (a cluster's or tracking server's address).
# Caches stay where they are, as compiling all kernels takes minutes.
for _name in [name for name in os.environ if name.startswith(("MLFLOW_", "RAY_"))]:
    del os.environ[_name]
os.environ.setdefault("XDG_CACHE_HOME", str(Path.home() / ".cache"))
_home = tempfile.TemporaryDirectory(prefix="gridsim-home-", ignore_cleanup_errors=True)
os.environ["HOME"] = _home.name

# A shell ignores Ctrl-C for what it starts in the background, and so would the commands that tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: an example that comes first may compile a kernel. CI's examples are the same in every run.
settings.register_profile("gridsim", settings.get_profile("ci" if os.environ.get("CI") else "default"), deadline=None)
settings.load_profile("gridsim")
signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which commands inherit: under nohup no closed terminal would stop them


@pytest.fixture(autouse=True)
def _nothing_is_left_for_later_tests() -> Iterator[None]:
    """Commands inherit whether Ctrl-C is ignored, and `ray start` reads a token at home."""
    yield
    assert not Path(_home.name, ".ray/auth_token").exists()
    assert signal.getsignal(signal.SIGINT) != signal.SIG_IGN
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


@pytest.fixture(scope="session")
def root() -> Path:
    return Path(__file__).resolve().parents[1]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder, which is the working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def empty_database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An MLflow database that has been created once, for tests to copy: creating one takes seconds."""
    from tracked import client

    from cluster.tracking.database import configure_mlflow, create_database

    configure_mlflow()
    path = tmp_path_factory.mktemp("mlflow") / "mlflow.db"
    create_database(path)
    client(f"sqlite:///{path}").create_experiment("other", artifact_location=(path.parent / "mlartifacts").as_uri())
    assert os.listdir(path.parent) == ["mlflow.db"]
    return path


@pytest.fixture
def database(empty_database: Path, tmp_path: Path) -> None:
    """The database that a run started in `tmp_path` logs to, created already."""
    shutil.copy(empty_database, tmp_path)


@pytest.fixture(scope="module")
def reference(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, empty_database: Path) -> Path:
    """The folder of a run that nobody disturbed, in one process: of the command and flags in a test's `REFERENCE`."""
    command, *flags = request.module.REFERENCE
    cwd = tmp_path_factory.mktemp("reference")
    shutil.copy(empty_database, cwd)
    finish(command, "--workers", "0", "--name", "ref", *flags, cwd=cwd)
    return cwd / "runs/ref"


@pytest.fixture
def uri(empty_database: Path, tmp_path: Path) -> str:
    """MLflow's address of a database that holds nothing but the experiment `other`."""
    from cluster.tracking.address import check_uri

    (tmp_path / "store").mkdir()
    shutil.copy(empty_database, tmp_path / "store" / "mlflow.db")
    return check_uri(f"sqlite:///{tmp_path}/store/mlflow.db")


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """MLflow in threads of this process, where a test can disturb it."""
    from tracked import InThisProcess

    from cluster.tracking import tracking

    monkeypatch.setattr(tracking, "Popen", InThisProcess)


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    from cluster.tracking import address, sync

    monkeypatch.setattr(sync, "SYNC_S", 0.05)
    monkeypatch.setattr(sync, "RETRY_S", 0.1)
    monkeypatch.setattr(sync, "LAST_RETRY_S", 0.1)
    monkeypatch.setattr(address, "PROBE_S", 1.0)


@pytest.fixture(scope="session")
def maps() -> dict[str, list]:
    """Two maps of each scenario."""
    from gridsim.maps.scenarios import REGISTRY, build

    return {name: [build(name, seed) for seed in range(2)] for name in REGISTRY}


@pytest.fixture(scope="module")
def curved() -> Iterator:
    """What builds maps of the scenario of that name, which are built fastest."""
    from cluster.learn.maps import Maps
    from gridsim.config import SimConfig

    with contextlib.closing(Maps("curved", SimConfig())) as kept:
        yield kept


@pytest.fixture
def audited(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Commands that add a variable to their environment while threads may read it fail the test."""
    late = tmp_path_factory.mktemp("audit") / "late"
    monkeypatch.setenv("AUDIT", str(late))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent / "support/audit"), prepend=os.pathsep)
    yield
    assert not late.exists(), late.read_text()


@pytest.fixture
def dummy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows that nobody sees."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing that a window could be opened on."""
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(variable, raising=False)


@pytest.fixture(scope="module")
def stand_ins(request: pytest.FixtureRequest) -> Iterator[None]:
    """Ray's workers, which know nothing of pytest's search path, can import what a test's file defines."""
    with pytest.MonkeyPatch.context() as patch:
        for folder in (Path(__file__).parent / "support", request.path.parent):
            patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        yield


@pytest.fixture
def cluster() -> Iterator[Callable[..., str]]:
    """Start a Ray cluster of so many CPUs, as users do; keywords are set in its environment. Returns its address."""
    from tracked import free_port

    with contextlib.ExitStack() as stack:

        def head(cpus: int, **environment: str) -> str:
            # In a user's own, `ray start` would name another head as the current one; paths of sockets are short.
            kept = tempfile.TemporaryDirectory(prefix="gridsim-", dir="/tmp", ignore_cleanup_errors=True)
            address, folder = f"127.0.0.1:{free_port()}", stack.enter_context(kept)
            flags = f"--head --port={address.partition(':')[2]} --include-dashboard=false --temp-dir={folder}"
            flags += f" --block --num-cpus={cpus} --object-store-memory=100000000"
            process = subprocess.Popen(
                [str(BIN / "ray"), "start", *flags.split()],
                env=os.environ | {"RAY_USAGE_STATS_ENABLED": "0"} | environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(end, process)
            wait_until(lambda: answers(address), 60)
            return address

        yield head
