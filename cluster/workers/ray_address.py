"""Addresses of Ray clusters, which are probed first: Ray itself tries for half a minute, and prints what it tries."""

from __future__ import annotations

import contextlib
import os
import socket
import time
from pathlib import Path

from cluster.redaction import redacted
from cluster.workers.pool import PoolError

PROBE_S = 3.0  # to connect, and to answer
AUTH_ENVIRONMENT = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


def probe(address: str) -> None:
    """Raises PoolError, one line, within seconds unless a Ray cluster answers at `host:port` and would let us in."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536 or "/" in address:
        raise PoolError(f"{redacted(address)!r} is not a Ray address; give host:port (of `ray start --head`) or auto")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), PROBE_S) as connection:
            if os.environ.get("RAY_USE_TLS", "0") not in ("", "0"):
                return
            answer = _ask_for_cluster_id(connection)
            if b"InvalidAuthToken" in answer and not has_token(host):
                raise PoolError(
                    f"the Ray cluster at {address} wants its token: set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN to "
                    "what `ray get-auth-token` says on its head"
                )
            if b"grpc-status" not in answer:
                raise PoolError(f"what answers at {address} is not a Ray cluster; is that its head's port?")
    except OSError as error:
        reason = f"no answer within {PROBE_S:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
        raise PoolError(f"no Ray cluster answers at {address}: {reason}; is `ray start --head` up?") from None


def _ask_for_cluster_id(connection: socket.socket) -> bytes:
    """Send Ray's simplest request (gRPC over HTTP/2), written by hand, without a token; returns the whole answer."""

    def frame(kind: int, flags: int, stream: int, body: bytes = b"") -> bytes:
        return len(body).to_bytes(3, "big") + bytes([kind, flags]) + stream.to_bytes(4, "big") + body

    headers = {
        b":method": b"POST",
        b":scheme": b"http",
        b":path": b"/ray.rpc.NodeInfoGcsService/GetClusterId",
        b":authority": b"ray",
        b"te": b"trailers",
        b"content-type": b"application/grpc",
    }
    literal = b"".join(bytes([0, len(k)]) + k + bytes([len(v)]) + v for k, v in headers.items())
    message = frame(4, 0, 0) + frame(1, 4, 1, literal) + frame(0, 1, 1, bytes(5))  # settings, headers, an empty message
    connection.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + message)
    answer, ends = b"", time.monotonic() + PROBE_S
    with contextlib.suppress(TimeoutError):
        while b"grpc-status" not in answer and time.monotonic() < ends and (part := connection.recv(4096)):
            answer += part
    return answer


def has_token(host: str) -> bool:
    """Whether Ray has a token to show to `host`. Unasked, it looks for one only if that is this machine; so do we."""
    if "RAY_AUTH_MODE" in os.environ:
        return os.environ["RAY_AUTH_MODE"].lower() == "token"
    family, kind, _, _, name = socket.getaddrinfo(host.strip("[]"), 0, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as trial:
        try:
            trial.bind(name)  # possible only for an address of this machine
        except OSError:
            return False
    return any(name in os.environ for name in AUTH_ENVIRONMENT) or (Path.home() / ".ray/auth_token").exists()
