"""Ray itself: our own on this machine, or a cluster that is joined; its settings and its error messages.

Only this file and `ray_pool` import Ray.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import logging
import os
import re
import secrets
import shutil
import site
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cluster
import evolution
import gridsim
from cluster.redaction import redacted
from cluster.workers.pool import PoolError
from cluster.workers.ray_address import AUTH_ENVIRONMENT, has_token, probe
from gridsim.jit import CACHE_FOLDER

# Read when Ray is imported and when it connects. Ray sets the last two itself, but only after threads have started.
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run` Ray would copy the working folder to every worker
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",  # no C++ stack trace on the terminal at SIGTERM
    "RAY_OVERRIDE_JOB_RUNTIME_ENV": "1",  # a job that was submitted with files of its own keeps them beside ours
    "RAY_CLIENT_MODE": "0",
    "PYTHONBREAKPOINT": "ray.util.rpdb._driver_set_trace",
}
# Read by the processes of a Ray of our own, besides the token.
OWN_ENVIRONMENT = {
    "RAY_raylet_client_connect_timeout_milliseconds": "20",  # it first just misses its object store, then sleeps 1 s
    "RAY_raylet_client_num_connect_attempts": "500",
    "RAY_prestart_worker_first_driver": "0",  # with it, init waits forever if a worker dies as it starts
    "RAY_enable_metrics_collection": "0",
    "RAY_task_events_report_interval_ms": "0",
    "RAY_worker_niceness": "0",  # Ray's 15 would let a busy machine starve the workers until patience ends the run
}
# Ray lets in whoever has its token. Ours must not outlive the run in ~/.ray, where it would change what `ray start`
# does from then on.
TOKEN = {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
MODE = {"RAY_AUTH_MODE": "token"}
STORE_BYTES = 768 << 20  # of shared memory, taken page by page as it is used; where there is less, Ray uses its folder
LONGEST_SOCKET = 107  # bytes that the path of a Unix socket may have
FILES = "r"  # Ray's folder, inside our private one: Ray lets all users write to the folder that it is given
SOCKET = f"/{FILES}/session_2026-01-01_00-00-00_000000_4194304/sockets/plasma_store"  # the longest path
ENDING_S = 5.0  # for the last of Ray's processes to end
PACKAGES = (cluster, evolution, gridsim)  # that are sent to a cluster's workers
ELSEWHERE = ("ActorUnavailableError", "NodeDiedError", "ObjectLostError", "OwnerDiedError", "ObjectFetchTimedOutError")
HOST_DIED = "its node has died"  # in an error's text


def check_address(address: str) -> str:
    """The `host:port` of the Ray cluster meant by `address` (`host:port`, or `auto`: RAY_ADDRESS, else this machine's).

    Raises PoolError, one line, within seconds if no Ray answers or it would not let us in.
    """
    if address == "auto":
        address = os.environ.get("RAY_ADDRESS") or "auto"
    if address == "auto":
        os.environ.update(ENVIRONMENT | os.environ)  # read when Ray is imported
        logging.getLogger("ray").setLevel(logging.CRITICAL)
        try:
            address = _private("services").canonicalize_bootstrap_address("auto")
        except ConnectionError:
            raise PoolError(
                "no Ray cluster runs on this machine; start one with `ray start --head`, or give its host:port"
            ) from None
    probe(address)
    return address


def cluster_address(given: str) -> str | None:
    """The `host:port` of the Ray cluster that a user gave by --address, else by RAY_ADDRESS; None for Ray of our own.

    An address for Ray's job server, as Ray's guide sets RAY_ADDRESS to, is left out with a warning.
    Raises PoolError as `check_address`; the line names RAY_ADDRESS if the address comes from there.
    """
    usual = os.environ.get("RAY_ADDRESS", "")
    by_variable = given in ("", "auto") and usual != ""
    address = usual if by_variable else given
    if address in ("", "local"):
        return None
    if by_variable and not given and address.startswith(("http://", "https://")):
        warnings.warn(
            f"RAY_ADDRESS={redacted(address)} is where Ray takes jobs, so this run uses this machine alone; to use the "
            "cluster, submit the command with `ray job submit`, or give --address host:port",
            stacklevel=2,
        )
        return None
    try:
        return check_address(address)
    except PoolError as error:
        if by_variable:
            raise PoolError(f"{error} (RAY_ADDRESS says so; unset it, or give --address local)") from None
        raise


def prepare(address: str | None) -> list[str]:
    """Set Ray's variables for the cluster at `host:port`, or a Ray of our own; to be called before there are threads.

    A new variable may move the environment, and a thread that reads it at this moment, in C, crashes the process.
    Returns: those to remove when Ray is left: with our token, a cluster that is joined next could not call us.
    """
    in_use = getattr(sys.modules.get("ray"), "is_initialized", None)  # None also while Ray is being imported
    if in_use and in_use():  # by the caller or another pool, so that the new pool will be refused
        return []
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    ours = {}
    if address is None:
        ours = OWN_ENVIRONMENT | MODE | ({} if any(name in os.environ for name in AUTH_ENVIRONMENT) else TOKEN)
    elif has_token(address.rpartition(":")[0]):  # as Ray does when it finds the cluster itself
        ours = MODE
    new = {name: value for name, value in ours.items() if name not in os.environ}
    os.environ.update(new)
    return list(new)


def restore(variables: list[str]) -> None:
    """Remove what `prepare` returned, once."""
    for name in variables:
        os.environ.pop(name, None)
    if "ray" in sys.modules and not MODE.keys().isdisjoint(variables):
        _read_token()
    variables.clear()


def own_folder() -> str:
    """Make a private folder (0700) for a Ray of our own: in RAY_TMPDIR, else in the temporary folder, else in /tmp.

    Ray's own choice, /tmp/ray, is open to all users of a machine. Raises PoolError.
    """
    bases, problem = ["/tmp"], "there is no temporary folder"
    if chosen := os.environ.get("RAY_TMPDIR"):
        bases = [chosen]
    else:
        with contextlib.suppress(FileNotFoundError):  # no temporary folder can be written to
            bases.insert(0, tempfile.gettempdir())
    for base in bases:
        try:
            folder = tempfile.mkdtemp(prefix="gs-", dir=os.path.abspath(base))
        except OSError as error:
            problem = f"{base}: {error.strerror}"
            continue
        if len(os.fsencode(folder + SOCKET)) <= LONGEST_SOCKET:
            return folder
        os.rmdir(folder)
        problem = f"the path of {base} is too long for its sockets"
    raise PoolError(f"Ray cannot be started: {problem}; set RAY_TMPDIR to a folder with room and a short path")


def start_own(workers: int, folder: str) -> None:
    """Start Ray on this machine with one CPU for each worker, its files in a folder of `own_folder`."""
    import ray

    _be_quiet()
    _read_token()
    with _lean_head():
        ray.init(
            address="local",  # whatever RAY_ADDRESS says
            num_cpus=workers,
            num_gpus=0,
            object_store_memory=STORE_BYTES,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.CRITICAL,
            runtime_env=_own_runtime_env(folder),
            _temp_dir=f"{folder}/{FILES}",
        )


def _own_runtime_env(folder: str) -> dict[str, Any]:
    """Ray's `runtime_env` for workers that import what this process imported, as `runtime_env` explains.

    They are not sent our packages: Numba would compile the kernels of unpacked copies anew.
    """
    empty = Path(folder, "empty")
    empty.mkdir()
    parents = dict.fromkeys(str(Path(package.__path__[0]).parent) for package in PACKAGES)
    # The workers have these on their path anyway, behind Python's own.
    installed = [*site.getsitepackages(), site.getusersitepackages()]
    path = [parent for parent in parents if parent not in installed]
    script = os.path.dirname(os.path.realpath(sys.argv[0]))
    path += filter(None, [os.environ.get("PYTHONPATH"), script if script in sys.path else ""])
    # A relative name of the cache's folder would mean another one there.
    variables = {"PYTHONPATH": os.pathsep.join(path), "GRIDSIM_CACHE_DIR": str(CACHE_FOLDER.parents[1])}
    return {"working_dir": str(empty), "env_vars": variables}


def lost_processes() -> str:
    """Which processes of a Ray of our own have ended by themselves, in words, or "". Calls to Ray may then hang."""
    with contextlib.suppress(ImportError, AttributeError):
        node = _private("worker")._global_node
        return ", ".join(str(kind) for kind, _ in node.dead_processes()) if node else ""
    return ""


def logs(folder: str) -> str:
    """The folder of the logs of a Ray of our own, or "" if there is none yet."""
    found = f"{folder}/{FILES}/session_latest/logs"
    return found if os.path.exists(found) else ""


def remove(folder: str) -> None:
    """Remove the folder of a Ray of our own that has been left; its last processes would make it again."""
    ends = time.monotonic() + ENDING_S
    while os.path.exists(folder) and time.monotonic() < ends:
        shutil.rmtree(folder, ignore_errors=True)
        time.sleep(0.1)


def join(address: str) -> None:
    """Connect to a cluster that passed `check_address`. This project's packages are sent to its workers.

    So a worker runs the very sources that the coordinator runs. Its node needs Ray, NumPy, Numba and SciPy (PyTorch
    if the network is a `cnn`), in the coordinator's versions.
    """
    import ray

    _be_quiet()
    _read_token()
    with tempfile.TemporaryDirectory() as empty:
        ray.init(address=address, runtime_env=runtime_env(empty), log_to_driver=False, logging_level=logging.CRITICAL)


def runtime_env(empty: str) -> dict[str, Any]:
    """Ray's `runtime_env` of a run's workers, some 200 KB, with the Ray job's files if the run is such a job.

    Args: `empty` is an empty folder. Without a `working_dir`, Ray puts this process's working folder first on its
    workers' path, where a user's `evolution.py` would be found in place of our package.
    """
    submitted = json.loads(os.environ.get("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")).get("runtime_env") or {}
    ours = [str(Path(package.__path__[0])) for package in PACKAGES]
    own_folder = {} if "working_dir" in submitted else {"working_dir": empty}
    return {"py_modules": [*ours, *submitted.get("py_modules", [])], "excludes": ["__pycache__"], **own_folder}


def leave() -> None:
    """Leave Ray."""
    import ray

    collecting = gc.isenabled()
    gc.disable()  # a reference to Ray that another thread's collection frees while Ray stops ends this process
    try:
        ray.shutdown(wait_for_processes=True)
    finally:
        if collecting:
            gc.enable()


def capacity() -> str:
    """What the cluster has to offer, in words."""
    import ray

    free, total = ray.available_resources().get("CPU", 0), ray.cluster_resources().get("CPU", 0)
    return f"Ray has {total:g} CPUs, {free:g} of them free, and a worker needs 1"


def is_to_blame(error: BaseException) -> bool:
    """Whether a worker may have died because of its work, not for want of memory or because its host is gone."""
    return type(error).__name__ not in ELSEWHERE and HOST_DIED not in str(error) and not memory_used(error)


def memory_used(error: BaseException) -> str:
    """How much memory was in use (`23.1GB of 23.5GB`), if Ray ended a worker because memory was short, else ""."""
    used = re.search(r"was ([\d.]+ ?\w+) used / ([\d.]+ ?\w+) limit", str(error))
    return f"{used[1]} of {used[2]}" if used and type(error).__name__ == "OutOfMemoryError" else ""


def failed_as_it_began(error: BaseException) -> bool:
    """Whether a worker could not be created because of an exception, which the next one would raise, too."""
    return "raised in its creation task" in str(error)


def reason(error: BaseException) -> str:
    """What matters in Ray's long messages."""
    text = (str(error).strip() or type(error).__name__).splitlines()[-1].strip()
    if used := memory_used(error):
        text = f"Ray ended it because its machine's memory is full ({used})"
    elif HOST_DIED in str(error):
        text = "its host is gone"
    elif "Worker exit detail: " in text:
        text = text.split("Worker exit detail: ")[1].split(". Some common causes")[0]
        if "connection error" in text:
            text = "its process was killed, crashed, or ran out of memory"
    return text[:300]


def _read_token() -> None:
    """Have Ray, which may have been used before in this process, read again what the environment says of a token."""
    with contextlib.suppress(ImportError, AttributeError):
        raylet = importlib.import_module("ray._raylet")
        raylet.Config.initialize("")
        raylet.AuthenticationTokenLoader.instance().reset_cache()


def _private(name: str) -> Any:
    return importlib.import_module(f"ray._private.{name}")


def _be_quiet() -> None:
    """Keep Ray from printing workers' deaths, which it does even without `log_to_driver`."""
    logging.getLogger("ray").setLevel(logging.CRITICAL)
    _private("worker")._worker_logs_enabled = False


@contextlib.contextmanager
def _lean_head() -> Iterator[None]:
    """Start Ray's head on loopback, without the helpers that only its dashboard, autoscaler and terminal output need.

    Nobody else can connect then, and a network that changes does not matter: as Ray does by itself on macOS.
    Its processes get groups of their own: a signal to our whole group would end them half started, and `ray.init` would
    then wait for a minute. Ray has no settings for these, so meanwhile this replaces private names.
    """
    with contextlib.ExitStack() as undo:
        with contextlib.suppress(ImportError, AttributeError, TypeError):  # a version of Ray without these names
            node, parameter, services = _private("node").Node, _private("parameter"), _private("services")
            constants = _private("ray_constants")
            lean = partial(parameter.RayParams, no_monitor=True, include_log_monitor=False)
            lean()
            group = 0 if sys.platform == "linux" else None  # elsewhere Ray ends its processes by our group
            replaced: list[tuple[Any, str, Any]] = [
                (constants, "ENABLE_RAY_CLUSTER", False),
                (node, "start_api_server", _no_api_server),
                (parameter, "RayParams", lean),
                (services, "ConsolePopen", partial(services.ConsolePopen, process_group=group)),
            ]
            for owner, name, value in replaced:
                undo.callback(setattr, owner, name, getattr(owner, name))
                setattr(owner, name, value)
        yield


def _no_api_server(self: Any, **_: Any) -> None:
    self._webui_url = ""
