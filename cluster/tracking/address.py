"""Tracking addresses: checked, made absolute, and shown without secrets. Does not import MLflow.

A server is probed here before MLflow is used: where no server answers, MLflow would hang for minutes.
"""

import contextlib
import importlib.util
import os
import re
import shlex
import socket
import sqlite3
import ssl
import urllib.error
import urllib.parse
import urllib.request
from importlib.metadata import entry_points
from pathlib import Path

from cluster.redaction import UNCLEAR, one_line, redacted
from gridsim.errors import GridSimError

DEFAULT_URI = "sqlite:///mlflow.db"
UI = "http://127.0.0.1:5000"  # where `make ui` and `mlflow ui` serve MLflow's UI by default
VIEW = "gridsim"  # key of the view that is saved with each experiment for MLflow's UI
PROBE_S = 3.0
_SERVERS = ("http", "https")
_DATABASES = {"postgresql": 5432, "mysql": 3306, "mssql": 1433}  # usual ports
_HOSTED = "databricks"  # MLflow's own scheme for a hosted store; plug-ins add other schemes
_LOOPBACK = ("127.0.0.1", "localhost", "::1", "[::1]")
_PAGE = "/api/2.0/mlflow/experiments/search?max_results=1"  # a request that gateways in front of MLflow pass on, too
_SQLITE = re.compile(r"sqlite(\+\w+)?:///(.+?)(?:\?([\w.-]+=[^/]*))?", re.IGNORECASE | re.DOTALL)
"""Driver, path and query. A path may have a question mark, too."""


class TrackingError(GridSimError):
    """MLflow cannot be used; the message is one line for the user."""


def check_uri(uri: str | None = None, begun_with: str = "") -> str:
    """The tracking address to use, checked without MLflow: a SQLite path is made absolute, and a server is probed.

    It is `uri`; if that is None or "", `begun_with` (the address of a resumed run), else MLFLOW_TRACKING_URI, else
    DEFAULT_URI. If MLFLOW_TRACKING_URI is the same address with user and password, these are added, so that no file and
    no flag needs to hold them. A server is not probed if `begun_with` is used or in a comparison's run
    (MLFLOW_RUN_CONTEXT is set): such runs go on without it. A hosted store or a plug-in's is never probed. Raises
    TrackingError for what cannot be used, such as a probed server that does not answer, a SQLite database that cannot
    be written or that another version of MLflow made, a folder (MLflow 3 keeps no runs in folders), an unknown scheme,
    or an address that its password makes unclear.
    """
    reach_loopback_directly()
    probed = (not uri and bool(begun_with)) or "MLFLOW_RUN_CONTEXT" in os.environ
    uri = with_password(uri or begun_with) or os.environ.get("MLFLOW_TRACKING_URI") or DEFAULT_URI
    scheme, shown = address_scheme(uri), redacted(uri)
    if scheme == "sqlite":
        return _check_sqlite(uri)
    if scheme == _HOSTED or scheme in entry_points(group="mlflow.tracking_store").names:
        return uri
    if scheme in ("", "file"):
        raise TrackingError(f"{shown}: MLflow 3 keeps no runs in folders; use {DEFAULT_URI} or http://host:port")
    if scheme not in (*_SERVERS, *_DATABASES):
        raise TrackingError(f"{shown}: not a tracking address; use {DEFAULT_URI} or http://host:port")
    if shown.endswith(UNCLEAR):
        raise TrackingError(f"{shown}: in a password, write ? as %3F, @ as %40 and / as %2F")
    uri = uri.rstrip("/")
    if not probed and (problem := unreachable(uri)):
        kind = "database" if scheme in _DATABASES else "MLflow"
        raise TrackingError(f"no {kind} server at {redacted(uri)}: {problem}; start one, or use {DEFAULT_URI}")
    return uri


def unreachable(uri: str) -> str:
    """Why no MLflow or database server answers at an address now; "" if one does.

    It is also "" for an address that names no server to be asked, such as a SQLite file's or a hosted store's.
    """
    scheme = address_scheme(uri)
    if scheme in _SERVERS:
        return _server_problem(redacted(uri))
    if scheme in _DATABASES:
        parts = urllib.parse.urlsplit(redacted(uri))  # redacted: a colon in a password would be taken for the port's
        try:
            if parts.hostname:  # an address without a host is a Unix socket's
                socket.create_connection((parts.hostname, parts.port or _DATABASES[scheme]), PROBE_S).close()
        except (OSError, ValueError) as error:
            return one_line(error, uri)
    return ""


def _server_problem(uri: str) -> str:
    """Why there is no MLflow server at `uri`, or "". Sends no credentials, so certificates are not checked."""
    unchecked = ssl.create_default_context()
    unchecked.check_hostname, unchecked.verify_mode = False, ssl.CERT_NONE
    try:
        with urllib.request.urlopen(uri + _PAGE, timeout=PROBE_S, context=unchecked) as answer:
            return "" if answer.read(64).lstrip().startswith(b"{") else "something else answers there"
    except urllib.error.HTTPError as error:
        if b"Invalid Host header" in error.read(200):
            return "it refuses this host name"
        return "" if error.code in (400, 401, 403, 405, 429) else f"it answers with error {error.code}"
    except Exception as error:  # refused, unknown host, timed out, no HTTP, no address at all
        return one_line(error)


def run_table(server: str, experiment_id: str) -> str:
    """Address of an experiment's run table in an MLflow server's UI; by default MLflow 3.17 opens another page."""
    page = f"#/experiments/{experiment_id}/runs?workflowType=machine_learning&viewStateShareKey={VIEW}"
    return f"{redacted(server)}/{page}"


def address_scheme(uri: str) -> str:
    """The scheme of a tracking address, in lower case and without a database's driver; "" for a mere path."""
    return _HOSTED if uri == _HOSTED else uri.partition(":")[0].partition("+")[0].lower() if ":" in uri else ""


def is_database(uri: str) -> bool:
    """Whether an address names a database, which MLflow opens in this process, and not an MLflow server."""
    return address_scheme(uri) in ("sqlite", *_DATABASES)


def is_locked(error: str | None) -> bool:
    """Whether an upload failed only because others are writing to the database, which soon passes."""
    return "database is locked" in (error or "")


def with_password(saved: str) -> str:
    """`saved`, an address from a file or a flag, with the password that MLFLOW_TRACKING_URI has for it.

    So a file or a flag needs to hold no password. An address that holds one stays as it is.
    """
    usual = os.environ.get("MLFLOW_TRACKING_URI", "").rstrip("/")
    plain = re.sub("//[^/:@]*@", "//", saved.rstrip("/"))  # the address without a name of a user
    return usual if redacted(usual) == redacted(plain) == plain and not saved.endswith(UNCLEAR) else saved


def reach_loopback_directly() -> None:
    """Exclude loopback addresses from the proxies that the environment names: no proxy can reach this machine's.

    To be called before there are threads, as it changes the environment.
    """
    excepted = urllib.request.getproxies_environment().get("no", "")
    if "*" not in excepted and _LOOPBACK[-1] not in excepted:
        os.environ["no_proxy"] = ",".join([*filter(None, [excepted]), *_LOOPBACK])


def _check_sqlite(uri: str) -> str:
    """The SQLite address `uri` with an absolute path; its database may be missing, empty or locked.

    Raises TrackingError if it names no file, if the database or its folder cannot be written, or if another version of
    MLflow made the database.
    """
    path, shown = sqlite_path(uri), redacted(uri)
    if path is None or path.is_dir():
        raise TrackingError(f"{shown}: names no file; use {DEFAULT_URI}")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise TrackingError(f"{shown}: there is no folder {path.parent} that can be written; create it first")
    match = _SQLITE.fullmatch(uri)
    absolute, found = sqlite_uri(path, match[3] if match else ""), []
    if path.exists() and path.stat().st_size:
        address = f"file:{urllib.parse.quote(str(path))}?mode=rw"
        try:
            with contextlib.closing(sqlite3.connect(address, 0.0, isolation_level=None, uri=True)) as database:
                database.execute("BEGIN IMMEDIATE")  # fails where writing would; closing undoes it
                if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'alembic_version'").fetchall():
                    found = database.execute("SELECT version_num FROM alembic_version").fetchall()
        except sqlite3.Error as error:
            if not is_locked(str(error)):  # `sync` waits for a locked one
                raise TrackingError(f"{shown}: not a database that can be written: {error}") from error
    if found and (problem := schema_problem(found[0][0], absolute)):
        raise TrackingError(problem)
    return absolute


def sqlite_path(uri: str) -> Path | None:
    """The database file of a SQLite address, absolute; None for another kind of address or a database in memory."""
    match = _SQLITE.fullmatch(uri)
    if not match or ":memory:" in match[2]:
        return None
    return Path(os.path.abspath(urllib.parse.unquote(match[2]) if match[1] else match[2]))


def sqlite_uri(path: Path, query: str | None = None) -> str:
    """The SQLite address of an absolute path.

    SQLAlchemy takes a question mark for the beginning of a query, and decodes %3F and the like; so ? and % in the path
    are encoded. MLflow would create folders with the encoded names, unless the address also names the driver.
    """
    text = str(path).replace("%", "%25").replace("?", "%3F")
    return f"sqlite{'+pysqlite' if text != str(path) else ''}:///{text}" + (f"?{query}" if query else "")


def schema_problem(revision: str | None, uri: str) -> str:
    """Why a database with this schema revision (None: none yet) must not be used, in one line; "" if it may be.

    MLflow would migrate an older database at once. The older MLflow that made it, perhaps another user's, could then no
    longer open it.
    """
    package = importlib.util.find_spec("mlflow")
    assert package is not None
    assert package.origin is not None
    files = Path(package.origin).parent.glob("store/db_migrations/versions/*.py")
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    known, followed = (
        set(re.findall(rf"^{name} = ['\"](\w+)", text, re.MULTILINE)) for name in ("revision", "down_revision")
    )
    if not revision or revision in known - followed:
        return ""
    return (
        f"{redacted(uri)} was made by another version of MLflow, or by another program; use another --tracking-uri, or "
        f"copy it and run mlflow db upgrade {shlex.quote(redacted(uri))}, after which an older MLflow cannot open it"
    )
