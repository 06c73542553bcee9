"""MLflow's databases: made whole or not at all, and never migrated. Imports MLflow."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from cluster.tracking.address import TrackingError, is_database, run_table, schema_problem, sqlite_path, sqlite_uri

# MLflow's own retries would go on for minutes. `sync` tries again instead.
_ENVIRONMENT = {
    "MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false",
    "MLFLOW_CONFIGURE_LOGGING": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}


def configure_mlflow() -> None:
    """Set MLflow's variables, before it is imported and before there are threads. What the user has set stays."""
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def check_schema(uri: str) -> None:
    """Raise TrackingError for a database of another version of MLflow, which would migrate it without asking."""
    if not is_database(uri):
        return
    from mlflow.store.db import utils

    engine = utils.create_sqlalchemy_engine(uri)
    try:
        revision = utils._get_schema_version(engine)
    finally:
        engine.dispose()
    if problem := schema_problem(revision, uri):
        raise TrackingError(problem)


def create_database(path: Path) -> None:
    """Make a new, complete MLflow database appear at `path`, unless another process is first.

    MLflow builds it by 60 migrations in a second. If it is killed in the middle, or two runs start together, what is
    left is a database that it can never open again. So it is built in another folder and then moved.
    """
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    with tempfile.TemporaryDirectory(prefix=".mlflow-", dir=path.parent) as folder:
        built = Path(folder, path.name)
        # The second argument is MLflow's default location, which breaks at some folders' names.
        SqlAlchemyStore(sqlite_uri(built), (path.parent / "mlartifacts").as_uri()).engine.dispose()
        try:
            os.link(built, path)
        except OSError:
            if not path.exists():  # on a file system without hard links
                os.rename(built, path)


def run_tables(uri: str, server: str) -> dict[str, str]:
    """`run_table` of each experiment that has runs in a store, by name."""
    configure_mlflow()
    from mlflow.tracking import MlflowClient

    path = sqlite_path(uri)
    if path and not path.exists():
        return {}
    client = MlflowClient(tracking_uri=uri)
    found = [each for each in client.search_experiments() if client.search_runs([each.experiment_id], max_results=1)]
    return {each.name: run_table(server, each.experiment_id) for each in found}
