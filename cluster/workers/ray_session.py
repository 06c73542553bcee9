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
import secrets
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cluster
import evolution
import gridsim
from cluster.workers.pool import PoolError
from cluster.workers.ray_address import AUTH_ENVIRONMENT, has_token, probe

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
}
# Ray listens on all interfaces and lets in whoever has its token. Ours must not outlive the run in ~/.ray, where it
# would change what `ray start` does from then on.
TOKEN = {"RAY_AUTH_TOKEN": secrets.token_hex(32)}
MODE = {"RAY_AUTH_MODE": "token"}
STORE_BYTES = 768 << 20  # of shared memory, taken page by page as it is used; where there is less, Ray uses /tmp
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


def start_own(workers: int, begun: Callable[[str], int]) -> None:
    """Start Ray on this machine with one CPU for each worker.

    Args: `begun` gets Ray's session folder, and returns a file descriptor, which all of Ray's processes inherit.
    """
    import ray

    _be_quiet()
    _read_token()
    with _lean_head(begun):
        ray.init(
            address="local",  # whatever RAY_ADDRESS says
            num_cpus=workers,
            num_gpus=0,
            object_store_memory=STORE_BYTES,
            include_dashboard=False,
            log_to_driver=False,
            logging_level=logging.CRITICAL,
        )


def join(address: str) -> None:
    """Connect to a cluster that passed `check_address`. This project's packages are sent to its workers.

    So a worker runs the very sources that the coordinator runs. Its node needs Ray, NumPy, Numba and SciPy (PyTorch
    if the network is a `cnn`), in the coordinator's versions.
    """
    import ray

    _be_quiet()
    _read_token()
    ray.init(address=address, runtime_env=runtime_env(), log_to_driver=False, logging_level=logging.CRITICAL)


def runtime_env() -> dict[str, Any]:
    """Ray's `runtime_env` of a run's workers, some 200 KB, with the Ray job's modules if the run is such a job."""
    submitted = json.loads(os.environ.get("RAY_JOB_CONFIG_JSON_ENV_VAR", "{}")).get("runtime_env") or {}
    ours = [str(Path(package.__path__[0])) for package in PACKAGES]
    return {"py_modules": [*ours, *submitted.get("py_modules", [])], "excludes": ["__pycache__"]}


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
    """Whether a worker may have died because of its work, and not because its host died or is out of reach."""
    return type(error).__name__ not in ELSEWHERE and HOST_DIED not in str(error)


def failed_as_it_began(error: BaseException) -> bool:
    """Whether a worker could not be created because of an exception, which the next one would raise, too."""
    return "raised in its creation task" in str(error)


def reason(error: BaseException) -> str:
    """What matters in Ray's long messages."""
    text = (str(error).strip() or type(error).__name__).splitlines()[-1].strip()
    if HOST_DIED in str(error):
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
def _lean_head(begun: Callable[[str], int]) -> Iterator[None]:
    """Start Ray's head without the helpers that only its dashboard, autoscaler and terminal output need.

    `begun` gets its session folder before its processes start, and they inherit what it opens. They get groups of
    their own: a signal to our whole group would end them half started, and `ray.init` would then wait for a minute. Ray
    has no settings for these, so meanwhile this replaces private names.
    """
    with contextlib.ExitStack() as undo:
        with contextlib.suppress(ImportError, AttributeError, TypeError):  # a version of Ray without these names
            node, parameter, services = _private("node").Node, _private("parameter"), _private("services")
            lean = partial(parameter.RayParams, no_monitor=True, include_log_monitor=False)
            lean()
            init_temp, popen = node._init_temp, services.ConsolePopen
            inherited: list[int] = []

            def make_folder(self: Any, *arguments: Any) -> None:
                init_temp(self, *arguments)
                inherited.append(begun(self._session_dir))

            group = 0 if sys.platform == "linux" else None  # elsewhere Ray ends its processes by our group
            replaced: list[tuple[Any, str, Any]] = [
                (node, "_init_temp", make_folder),
                (node, "start_api_server", _no_api_server),
                (parameter, "RayParams", lean),
                (services, "ConsolePopen", partial(popen, pass_fds=inherited, process_group=group)),
            ]
            for owner, name, value in replaced:
                undo.callback(setattr, owner, name, getattr(owner, name))
                setattr(owner, name, value)
        yield


def _no_api_server(self: Any, **_: Any) -> None:
    self._webui_url = ""
