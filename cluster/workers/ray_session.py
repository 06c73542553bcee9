"""Starts a Ray of our own on this machine, or joins a cluster, by Ray's public API alone; explains Ray's errors."""

from __future__ import annotations

import gc
import logging
import os
import secrets
import shutil
import socket
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cluster import stopping
from cluster.workers.child import Child
from cluster.workers.pool import LOOK_S, PoolError, last_line
from gridsim.jit import CACHE_FOLDER

PACKAGES = ("cluster", "evolution", "gridsim")  # our packages, which are sent to the workers
ENVIRONMENT = {
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run` Ray would copy the working folder to every worker
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",  # no C++ stack trace on the terminal at SIGTERM
    "RAY_OVERRIDE_JOB_RUNTIME_ENV": "1",  # in a Ray job that has files of its own, ours override them (else: an error)
    # Ray itself sets the next two variables, when there may be threads. Adding a variable beside threads is unsafe, so
    # they are added before.
    "RAY_CLIENT_MODE": "0",
    "PYTHONBREAKPOINT": "ray.util.rpdb._driver_set_trace",
    "RAY_DEDUP_LOGS_SKIP_REGEX": ".",  # matches every line: Ray prints none about workers here, not even that one died
}
CLUSTER_ENVIRONMENT = {  # added where an address is given, to fail soon if what answers at it is not Ray
    "RAY_py_gcs_connect_timeout_s": "3",  # for each of three requests
    "RAY_gcs_server_port_wait_time_s": "1",
}
OWN_ENVIRONMENT = {  # added for a Ray of our own, which admits only who has its token
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # Ray listens on loopback alone, its default on Windows and macOS
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
}
HEAD_ENVIRONMENT = {  # for the processes of a Ray of our own, not for this one
    "RAY_prestart_worker_first_driver": "0",  # Ray starts no workers early, which would lack our environment
    "RAY_worker_niceness": "0",  # with Ray's 15, other programs could starve the workers, until --patience ends the run
    "GRIDSIM_CACHE_DIR": str(CACHE_FOLDER.parents[1]),  # absolute: Ray's processes have another working folder
}
MEANINGS = {  # what Ray's errors mean, by what their long texts contain
    "OutOfMemoryError": "memory is full where it ran; close other programs there, or give fewer --workers",
    "its node has died": "its host is gone",
    "a connection error": "its process was killed, crashed, or ran out of memory",
    "AuthenticationError": "it wants its token: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to its head's "
    "`ray get-auth-token`",
    "Failed to connect to GCS": "what answers there is not a Ray cluster; is that its head's port?",
    "Could not find any running": "none runs on this machine; start one with `ray start --head`, or give its host:port",
    "Version mismatch": "it has another version of Ray or Python",
}
# Size of Ray's object store, in shared memory, which is taken page by page as it is used. On a machine with less shared
# memory, Ray uses files in its folder.
STORE_BYTES = 768 << 20
ENDING_S = 10.0  # time that Ray's processes get to end by themselves
_has_token = False  # whether OWN_ENVIRONMENT was set when Ray was imported, which is when Ray reads it


class Session:
    """This process's connection to a cluster, or to a Ray of our own, which `ray start` runs in a private folder."""

    _folder, _joined = "", False
    _head: Child | None = None

    def open(self, cpus: int, address: str | None, patience_s: float) -> Any:
        """Join a cluster, or if `address` is None start a Ray of our own with `cpus` CPUs. Returns the module `ray`.

        If this process has initialised Ray already, that is used. Raises PoolError.
        """
        global _has_token
        ray, cure = sys.modules.get("ray"), "or evaluate in this process (workers=0)"
        if ray and getattr(ray, "is_initialized", bool)():
            if address not in (None, "auto"):
                raise PoolError(f"Ray is in use in this process already: leave the address out to use it, {cure}")
            return ray  # a notebook's, or Ray Tune's; it is not ours to shut down
        if address is None and ray and not _has_token:
            raise PoolError(f"Ray was imported before it could be given a token: open the pool before that, {cure}")
        _has_token = _has_token or address is None
        wanted = ENVIRONMENT | (OWN_ENVIRONMENT if address is None else CLUSTER_ENVIRONMENT)
        new = wanted.keys() - os.environ.keys()
        # Set now, since threads that start later may read the environment at any time.
        os.environ.update({name: wanted[name] for name in new})
        try:
            return self._join(address or self._start(cpus, patience_s))
        finally:
            for name in new:  # else programs that this process starts would use our token
                os.environ.pop(name, None)

    def _start(self, cpus: int, patience_s: float) -> str:
        """Start a Ray of our own, wait until it is up, and return its address. Raises PoolError."""
        base, cure = os.environ.get("RAY_TMPDIR") or "/tmp", "set RAY_TMPDIR to a folder with room and a short path"
        try:
            self._folder = tempfile.mkdtemp(prefix="gs-", dir=os.path.abspath(base))  # /tmp/ray would be open to all
        except OSError as error:
            raise PoolError(f"Ray cannot be started: {base}: {error.strerror}; {cure}") from None
        with socket.create_server(("127.0.0.1", 0)) as free:
            client = f" --ray-client-server-port={free.getsockname()[1]}" if find_spec("grpc") else ""  # nobody uses it
        flags = f"""--head --block --port=0 --num-cpus={cpus} --num-gpus=0 --object-store-memory={STORE_BYTES}
            {client} --dashboard-agent-listen-port=0 --min-worker-port=0 --max-worker-port=0
            --include-dashboard=false --include-log-monitor=false --no-monitor --disable-usage-stats --temp-dir"""
        command = [sys.executable, "-P", "-m", "ray.scripts.scripts", "start", *flags.split(), f"{self._folder}/r"]
        log, found = Path(self._folder, "log"), Path(self._folder, "r/ray_current_cluster")
        self._head = Child(command, os.environ | HEAD_ENVIRONMENT, log)
        ends = time.monotonic() + patience_s
        import ray  # noqa: F401 - it takes a second, in which Ray's processes start

        while not (address := found.read_text() if found.exists() else ""):
            stopping.check()  # first: a Ctrl-C may have ended the child before it had a session of its own
            if self._head.exit_code() is not None:
                lines = log.read_text(errors="replace").splitlines()
                said = [line for line in lines if "Error: " in line] or lines or ["its log is empty"]
                raise PoolError(f"Ray cannot be started: {said[-1].strip()}; {cure}")
            if time.monotonic() > ends:
                raise PoolError(f"Ray is not up after {patience_s:g} s (--patience), perhaps as this machine is busy")
            time.sleep(LOOK_S)
        return address

    def _join(self, address: str) -> Any:
        """Connect to the Ray at an address. Its workers are sent our packages, so that they run the same sources."""
        import ray

        terminal, self._joined = os.dup(2), True
        # If it is initialised in a thread, Ray leaves the handlers of signals alone. Without a `working_dir`, Ray puts
        # this process's working folder first on `sys.path` of the workers, where a user's `evolution.py` would hide our
        # package.
        with tempfile.TemporaryDirectory() as empty, open(os.devnull, "w") as nowhere, ThreadPoolExecutor(1) as thread:
            modules = [str(Path(__file__).parents[2] / package) for package in PACKAGES]
            sent = {"py_modules": modules, "excludes": ["__pycache__"], "working_dir": empty}
            quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.CRITICAL}
            os.dup2(nowhere.fileno(), 2)  # Ray prints while it waits for an answer
            try:
                error = thread.submit(ray.init, address, runtime_env=sent, **quiet).exception()
            finally:
                os.dup2(terminal, 2)
                os.close(terminal)
        if error:
            raise PoolError(f"could not join the Ray cluster at {address}: {reason(error)}") from error
        return ray

    def check(self) -> None:
        """Raise PoolError if a process of our own Ray has ended: calls to Ray would then hang, or end this process."""
        if self._head and not self._head.is_whole():
            logs, self._folder = f"{self._folder}/r/session_latest/logs", ""  # the logs are kept
            raise PoolError(f"a process of Ray's on this machine was killed or has crashed (logs: {logs})")

    def close(self) -> None:
        """Leave Ray, unless this process used it before `open`; if it is our own, end it and remove its folder.

        May be called again.
        """
        if self._joined:
            gc.disable()  # this process would crash if a thread's collection freed a Ray reference while Ray stops
            sys.modules["ray"].shutdown()
            gc.enable()
        if self._head:
            self._head.close(ENDING_S)
        self._joined, self._head, ends = False, None, time.monotonic() + ENDING_S
        while self._folder and os.path.exists(self._folder) and time.monotonic() < ends:
            shutil.rmtree(self._folder, ignore_errors=True)  # Ray's last processes may still write to it


def reason(error: BaseException) -> str:
    """What one of Ray's long messages means, in one line."""
    text = f"{type(error).__name__}: {error} {error.__cause__}"
    return next((meaning for sign, meaning in MEANINGS.items() if sign in text), last_line(error)[:300])
