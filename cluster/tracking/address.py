"""Tracking addresses: which may be used, made absolute, and how they are shown. Knows nothing of MLflow.

An address is looked at before MLflow is: given a dead one it would hang for minutes.
"""

import contextlib
import os
import re
import socket
import sqlite3
import ssl
import threading
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

from gridsim.errors import GridSimError

DEFAULT_URI = "sqlite:///mlflow.db"
UI = "http://127.0.0.1:5000"  # where `make ui` and `mlflow ui` show it
PROBE_S = 3.0
_SERVERS = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}


class TrackingError(GridSimError):
    """MLflow cannot be used as asked; its text is one line for the user."""


def check_uri(uri: str | None = None) -> str:
    """The tracking address made absolute, after a look whether it can be used: 4 s at most, and without MLflow.

    None stands for MLFLOW_TRACKING_URI and, where that is not set, for `sqlite:///mlflow.db` in the working directory.
    Raises TrackingError for a server that does not answer, a database that cannot be written, a folder (MLflow 3
    stores nothing in folders) and anything unknown.
    """
    uri = uri or os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI
    scheme = uri.partition("://")[0].partition("+")[0].lower() if "://" in uri else ""
    if scheme == "sqlite":
        return _check_sqlite(uri)
    if scheme in ("http", "https"):
        return _check_http(uri)
    if scheme in _SERVERS:
        return _check_server(uri, _SERVERS[scheme])
    if scheme in ("", "file"):
        raise TrackingError(f"{uri}: MLflow 3 keeps no runs in folders; use sqlite:///mlflow.db or http://host:port")
    raise TrackingError(f"{shown(uri)}: not a tracking address; use sqlite:///mlflow.db or http://host:port")


def _check_sqlite(uri: str) -> str:
    """The address with an absolute path, after the database, or the folder for it, was found to be writable."""
    path = sqlite_path(uri)
    if path is None:
        raise TrackingError(f"{uri}: names no file; use sqlite:///mlflow.db")
    if not path.parent.is_dir():
        raise TrackingError(f"{uri}: there is no folder {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise TrackingError(f"{uri}: the folder {path.parent} cannot be written")
    if path.is_dir():
        raise TrackingError(f"{uri}: {path} is a folder; name a file")
    if path.exists() and path.stat().st_size:
        try:
            with contextlib.closing(connect(path, "rw")) as database:
                database.execute("BEGIN IMMEDIATE")
                database.execute("PRAGMA schema_version").fetchone()
                database.execute("ROLLBACK")
        except sqlite3.Error as error:
            raise TrackingError(f"{uri}: not a database that can be written: {error}") from error
    query = uri.partition("?")[2]
    return f"sqlite:///{path}" + (f"?{query}" if query else "")


def sqlite_path(uri: str) -> Path | None:
    """The database file of a SQLite address, absolute; None for another kind of address or a database in memory."""
    match = re.fullmatch(r"sqlite(?:\+\w+)?:///([^?]+)(?:\?.*)?", uri)
    return None if match is None or match[1] == ":memory:" else Path(os.path.abspath(match[1]))


def _check_http(uri: str) -> str:
    """The address of a server, without a slash at its end, after an MLflow server answered there."""
    uri = uri.rstrip("/")
    problem: list[str | None] = []
    # In a thread, as nothing else bounds the time that looking up a name takes.
    thread = threading.Thread(target=lambda: problem.append(_probe_http(uri)), daemon=True)
    thread.start()
    thread.join(PROBE_S + 1.0)
    reason = problem[0] if problem else f"no answer within {PROBE_S:g} s"
    if reason:
        raise TrackingError(f"no MLflow server at {shown(uri)}: {reason}; start one, or use {DEFAULT_URI}")
    return uri


def _probe_http(uri: str) -> str | None:
    """What speaks against an MLflow server at `uri`, or None. Sends no credentials, and so checks no certificate."""
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    for page in ("/health", "/api/2.0/mlflow/experiments/search?max_results=1"):  # a gateway may know but the second
        url = re.sub(r"//[^/@]*@", "//", uri) + page
        try:
            with urllib.request.urlopen(url, timeout=PROBE_S, context=unchecked) as answer:
                if answer.read(64).lstrip().startswith((b"OK", b"{")):
                    return None
        except urllib.error.HTTPError as error:
            if error.code in (400, 401, 403, 405, 429):
                return None if b"Invalid Host header" not in error.read(200) else "it refuses this host name"
            if error.code >= 500:
                return f"it answers with error {error.code}"
        except Exception as error:  # refused, unknown host, timed out, no HTTP, no address at all
            return one_line(error)
    return "something else answers there"


def _check_server(uri: str, port: int) -> str:
    """The address of a database server, after something answered there."""
    try:
        parts = urllib.parse.urlsplit(uri)
        socket.create_connection((parts.hostname or "localhost", parts.port or port), PROBE_S).close()
    except (OSError, ValueError) as error:
        raise TrackingError(f"no database server at {shown(uri)}: {one_line(error)}") from error
    return uri


def connect(path: Path, mode: str) -> sqlite3.Connection:
    """A SQLite database opened as its URI's `mode` says: ro, rw or rwc."""
    address = f"file:{urllib.parse.quote(str(path))}?mode={mode}"
    return sqlite3.connect(address, timeout=PROBE_S, isolation_level=None, uri=True)


def shown(uri: str) -> str:
    """An address without its password."""
    return re.sub(r"//[^/@\s]*@", "//", uri)


def one_line(error: BaseException) -> str:
    """The error in one line without a password; of a failed connection only what went wrong."""
    text = str(error) or type(error).__name__
    reasons = re.findall(r"\[Errno -?\d+\] ([^'\")\]]+)", text)
    if reasons:
        return reasons[-1].strip()
    if "timed out" in text.lower():
        return "no answer in time"
    return shown(text.splitlines()[0])[:200]
