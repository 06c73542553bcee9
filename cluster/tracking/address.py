"""Tracking addresses: checked, made absolute, and shown without passwords. Does not import MLflow.

An address is probed before MLflow is imported: with a dead one MLflow would hang for minutes.
"""

import contextlib
import os
import re
import socket
import sqlite3
import ssl
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

from gridsim.errors import GridSimError

DEFAULT_URI = "sqlite:///mlflow.db"
UI = "http://127.0.0.1:5000"  # where `make ui` and `mlflow ui` show it
PROBE_S = 3.0
_DATABASES = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}  # usual ports
_PAGE = "/api/2.0/mlflow/experiments/search?max_results=1"  # also served by a gateway in front of MLflow


class TrackingError(GridSimError):
    """MLflow cannot be used; the message is one line for the user."""


def check_uri(uri: str | None = None, begun_with: str = "") -> str:
    """The tracking address made absolute and probed, without MLflow.

    None stands for the address that a resumed run was begun with; its server need not answer, as the run goes on and
    the tracker reports it. Its password, which no file holds, comes from MLFLOW_TRACKING_URI. For a new run it is
    MLFLOW_TRACKING_URI, or `sqlite:///mlflow.db` in the working directory.
    Raises TrackingError for a server that does not answer, a database that cannot be written, a folder (MLflow 3
    stores nothing in folders) and anything unknown.
    """
    resumed = not uri and bool(begun_with)
    uri = uri or with_password(begun_with) or os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI
    scheme = uri.partition("://")[0].partition("+")[0].lower() if "://" in uri else ""
    if resumed and scheme in ("http", "https", *_DATABASES):
        return uri
    if scheme == "sqlite":
        return _check_sqlite(uri)
    if scheme in ("http", "https"):
        uri = uri.rstrip("/")
        if problem := server_problem(uri):
            raise TrackingError(f"no MLflow server at {shown(uri)}: {problem}; start one, or use {DEFAULT_URI}")
        return uri
    if scheme in _DATABASES:
        parts = urllib.parse.urlsplit(uri)
        try:
            socket.create_connection((parts.hostname or "localhost", parts.port or _DATABASES[scheme]), PROBE_S).close()
        except (OSError, ValueError) as error:
            raise TrackingError(f"no database server at {shown(uri)}: {one_line(error)}") from error
        return uri
    if scheme in ("", "file"):
        raise TrackingError(f"{uri}: MLflow 3 keeps no runs in folders; use sqlite:///mlflow.db or http://host:port")
    raise TrackingError(f"{shown(uri)}: not a tracking address; use sqlite:///mlflow.db or http://host:port")


def with_password(saved: str) -> str:
    """The address that a run was begun with, with the user and password that MLFLOW_TRACKING_URI may have for it."""
    usual = os.environ.get("MLFLOW_TRACKING_URI", "").rstrip("/")
    return usual if shown(usual) == saved else saved


def _check_sqlite(uri: str) -> str:
    """The address with an absolute path. Raises TrackingError if the database, or its folder, cannot be written."""
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
            address = f"file:{urllib.parse.quote(str(path))}?mode=rw"
            with contextlib.closing(sqlite3.connect(address, PROBE_S, isolation_level=None, uri=True)) as database:
                database.execute("BEGIN IMMEDIATE")  # fails where writing would; closing undoes it
        except sqlite3.Error as error:
            raise TrackingError(f"{uri}: not a database that can be written: {error}") from error
    query = uri.partition("?")[2]
    return f"sqlite:///{path}" + (f"?{query}" if query else "")


def sqlite_path(uri: str) -> Path | None:
    """The database file of a SQLite address, absolute; None for another kind of address or a database in memory."""
    match = re.fullmatch(r"sqlite(?:\+\w+)?:///([^?]+)(?:\?.*)?", uri)
    return None if match is None or match[1] == ":memory:" else Path(os.path.abspath(match[1]))


def server_problem(uri: str) -> str:
    """Why there is no MLflow server at `uri`, or "". Sends no credentials, so certificates are not checked."""
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    try:
        with urllib.request.urlopen(shown(uri) + _PAGE, timeout=PROBE_S, context=unchecked) as answer:
            return "" if answer.read(64).lstrip().startswith(b"{") else "something else answers there"
    except urllib.error.HTTPError as error:
        if b"Invalid Host header" in error.read(200):
            return "it refuses this host name"
        if error.code >= 500:
            return f"it answers with error {error.code}"
        return "" if error.code in (400, 401, 403, 405, 429) else "something else answers there"
    except Exception as error:  # refused, unknown host, timed out, no HTTP, no address at all
        return one_line(error)


def shown(uri: str) -> str:
    """An address, or a text that may hold one, without user and password."""
    return re.sub(r"(?<=:)//[^/@\s]*@", "//", uri)


def one_line(error: BaseException) -> str:
    """The error in one line, without a password; of what the system refused only why."""
    text = str(error) or type(error).__name__
    reasons = re.findall(r"\[Errno -?\d+\] ([^'\")\]>:]+)", text)
    if reasons:
        return reasons[-1].strip()
    if "timed out" in text.lower():
        return "no answer in time"
    lines = text.splitlines()
    # SQLAlchemy may put a hint of its own before what went wrong.
    return shown(lines[1] if text.startswith("(raised as") and len(lines) > 1 else lines[0])[:200]
