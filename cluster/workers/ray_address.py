"""Where Ray is and what it finds there: addresses that are probed before Ray hangs on them, the environment of its
processes, room in shared memory. Nothing here imports Ray itself; only `ray_pool` does.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import secrets
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from cluster.workers.pool import PoolError

PROBE_S = 3.0
STORE_BYTES = 768 << 20  # of shared memory, taken page by page as it is used
LEAST_STORE_BYTES = 80 << 20  # Ray takes no less than 75 MiB

# Read when Ray is imported.
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",  # under `uv run` Ray would copy the working folder to every worker
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",  # no C++ stack trace on the terminal when we are told to stop
}
# Read by the processes of a Ray of our own.
OWN_ENVIRONMENT = {
    "RAY_raylet_client_connect_timeout_milliseconds": "20",  # it just misses its object store, and then sleeps 1 s
    "RAY_raylet_client_num_connect_attempts": "500",
    "RAY_prestart_worker_first_driver": "0",  # with it, init waits for ever where a worker dies as it starts
    "RAY_enable_metrics_collection": "0",
    "RAY_task_events_report_interval_ms": "0",
}
TOKEN = secrets.token_hex(32)
_ends_at_once = threading.Event()
AUTH_ENVIRONMENT = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


def probe(address: str) -> None:
    """Raises PoolError, one line, within 3 s unless a Ray cluster answers at `host:port` and would let us in."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536 or "/" in address:
        raise PoolError(f"{address!r} is no address of a Ray cluster; give host:port (of `ray start --head`) or auto")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), PROBE_S) as connection:
            if os.environ.get("RAY_USE_TLS", "0") in ("", "0"):
                answer = _ask_for_cluster_id(connection)
                if b"InvalidAuthToken" in answer and not has_token(host):
                    raise PoolError(
                        f"the Ray cluster at {address} wants its token: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to "
                        "what `ray get-auth-token` says on its head"
                    )
                if b"grpc-status" not in answer:
                    raise PoolError(f"what answers at {address} is no Ray cluster; is that its head's port?")
    except OSError as error:
        reason = f"no answer within {PROBE_S:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
        raise PoolError(f"no Ray cluster answers at {address}: {reason}; is `ray start --head` up?") from None


def _ask_for_cluster_id(connection: socket.socket) -> bytes:
    """Ray's simplest request (gRPC over HTTP/2) written by hand, without a token; returns all of the answer."""

    def frame(kind: int, flags: int, stream: int, body: bytes = b"") -> bytes:
        return len(body).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + body

    headers = {
        ":method": "POST",
        ":scheme": "http",
        ":path": "/ray.rpc.NodeInfoGcsService/GetClusterId",
        ":authority": "ray",
        "te": "trailers",
        "content-type": "application/grpc",
    }
    literal = b"".join(bytes([0, len(k)]) + k.encode() + bytes([len(v)]) + v.encode() for k, v in headers.items())
    message = frame(4, 0, 0) + frame(1, 4, 1, literal) + frame(0, 1, 1, bytes(5))  # settings, headers, an empty message
    connection.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + message)
    answer, until = b"", time.monotonic() + PROBE_S
    with contextlib.suppress(TimeoutError):
        while b"grpc-status" not in answer and (left := until - time.monotonic()) > 0:
            connection.settimeout(left)
            part = connection.recv(4096)
            if not part:
                break
            answer += part
    return answer


def has_token(host: str) -> bool:
    """Whether Ray has a token to show there. It looks for one by itself on the own machine only, and so do we."""
    if "RAY_AUTH_MODE" in os.environ:
        return os.environ["RAY_AUTH_MODE"].lower() == "token"
    family, kind, _, _, name = socket.getaddrinfo(host.strip("[]"), 0, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as trial:
        try:
            trial.bind(name)  # possible for an address of this machine alone
        except OSError:
            return False
    return any(name in os.environ for name in AUTH_ENVIRONMENT) or (Path.home() / ".ray/auth_token").exists()


@contextlib.contextmanager
def environment(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started meanwhile; what the user has set stays."""
    ours = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(ours)
    try:
        yield
    finally:
        for name in ours:
            os.environ.pop(name, None)


def end_at_once() -> None:
    """End this process where Python is done with it, with its own exit status, before any C++ destructors run.

    Ray leaves a dozen native threads behind at `shutdown` (gRPC's, its GCS client's). They go on while destructors pull
    the ground from under them, and once in some thousands of times abort a process that has done all of its work.
    """
    libc = ctypes.CDLL(None)
    if not _ends_at_once.is_set() and hasattr(libc, "on_exit"):  # glibc's; the last to be registered comes first
        _ends_at_once.set()
        libc.on_exit(ctypes.cast(libc._exit, ctypes.c_void_p), None)


def _started_by(threads: Iterable[Path]) -> list[int]:
    """Processes that threads have started, and what these have, by the files in which Linux tells of them."""
    found: list[int] = []
    for children in threads:
        with contextlib.suppress(OSError):
            found += [int(process) for process in children.read_text().split()]
    return found and found + _started_by(
        file for process in found for file in Path(f"/proc/{process}/task").glob("*/children")
    )


def abandon(thread: threading.Thread, booted: threading.Event) -> bool:
    """End what a thread has started of a Ray of our own that is not up yet, and remove its folder of logs.

    Starting takes seconds, on a busy machine half a minute, and cannot be stopped: the thread goes on waiting for Ray's
    processes when they are gone. Returns whether it was done: not if Ray is up meanwhile, nor where the system does not
    tell a thread's processes (macOS).
    """
    own = Path(f"/proc/self/task/{thread.native_id}/children")
    root = Path(os.environ.get("RAY_TMPDIR") or os.environ.get("TMPDIR") or "/tmp")
    if not own.exists():
        return False
    # It waits for Ray's first process to write this file, and nothing else can run in ours until it does.
    while not (ports := sorted(root.glob(f"ray/session_*_{os.getpid()}/gcs_server_port_*"))):
        if booted.wait(0.01):
            return False
    for process in _started_by([own]):
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    shutil.rmtree(ports[-1].parent, ignore_errors=True)
    return True


@contextlib.contextmanager
def no_interrupt() -> Iterator[None]:
    """Ignore Ctrl-C meanwhile (where signals can be set: in the main thread)."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def store_bytes() -> int:
    """Size of the object store: small, and smaller where shared memory is (a container's default is 64 MB)."""
    try:
        free = shutil.disk_usage("/dev/shm").free
    except OSError:
        return STORE_BYTES
    return max(min(STORE_BYTES, free * 9 // 10), LEAST_STORE_BYTES)
