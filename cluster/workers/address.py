"""Addresses of Ray clusters: what a user gives, and what RAY_ADDRESS says. This does not import Ray."""

from __future__ import annotations

import os
import socket
import warnings

from cluster.redaction import redacted
from cluster.workers.pool import PoolError

CONNECT_S = 3.0  # longest wait until something answers at an address


def cluster_address(given: str) -> str | None:
    """The Ray cluster to join, `host:port` or `auto`; None: this machine alone.

    It is `given` (--address), or RAY_ADDRESS if that is set and `given` is "" or `auto`; `local` means this machine.
    Ray's guide sets RAY_ADDRESS to http://..., where Ray takes jobs. That is no cluster to join: if `given` is "", it
    is ignored with a warning. Raises PoolError as `check_address`.
    """
    usual = os.environ.get("RAY_ADDRESS", "")
    if usual == "" or given not in ("", "auto"):
        return None if given in ("", "local") else check_address(given)
    if given == "" and usual.startswith(("http://", "https://")):
        text = f"RAY_ADDRESS={redacted(usual)} is where Ray takes jobs, so this run uses this machine alone; to use the"
        warnings.warn(f"{text} cluster, submit the command with `ray job submit`, or give --address host:port", None, 2)
        return None
    try:
        return None if usual == "local" else check_address(usual)
    except PoolError as error:
        raise PoolError(f"{error} (RAY_ADDRESS says so; unset it, or give --address local)") from None


def check_address(address: str) -> str:
    """The address itself. Raises PoolError, within seconds, if it is not `host:port` or `auto`, or nothing answers.

    Only `host:port` is tried; `auto` is not.
    """
    host, _, port = address.rpartition(":")
    if address != "auto" and (not host or not port.isdecimal() or not 0 < int(port) < 65_536 or "/" in address):
        raise PoolError(f"{redacted(address)!r} is not a Ray address; give host:port (of `ray start --head`) or auto")
    try:
        if address != "auto":
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
    except OSError as error:
        why = f"no answer within {CONNECT_S:g} s" if isinstance(error, TimeoutError) else error.strerror or str(error)
        raise PoolError(f"no Ray cluster answers at {address}: {why}; is `ray start --head` up?") from None
    return address
