"""MLflow's databases: made whole or not at all, and never migrated. Imports MLflow."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from cluster.tracking.address import TrackingError, is_database, run_table, schema_problem, sqlite_path, sqlite_uri

# Defaults for MLflow's variables. Its own retries would go on for minutes, so there are none: `sync` tries again.
_ENVIRONMENT = {
    "MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false",
    "MLFLOW_CONFIGURE_LOGGING": "false",
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "0",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}


def configure_mlflow() -> None:
    """Set the environment variables of _ENVIRONMENT, except those that are set already.

    To be called before MLflow is imported and before there are threads.
    """
    for name, value in _ENVIRONMENT.items():
        os.environ.setdefault(name, value)


def check_schema(uri: str) -> None:
    """Raise TrackingError for a database that another MLflow version made: MLflow would migrate it without asking."""
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

    MLflow builds a database by dozens of migrations, which take a second. If it is killed meanwhile, or two runs start
    together, it can never open that database again. So the database is built in another folder and then moved.
    """
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

    with tempfile.TemporaryDirectory(prefix=".mlflow-", dir=path.parent) as folder:
        built = Path(folder, path.name)
        # The second argument replaces MLflow's default place for runs' files, which breaks at some folders' names.
        SqlAlchemyStore(sqlite_uri(built), (path.parent / "mlartifacts").as_uri()).engine.dispose()
        try:
            os.link(built, path)
        except OSError:
            if not path.exists():  # on a file system without hard links
                os.rename(built, path)


def run_tables(uri: str, server: str) -> dict[str, str]:
    """The address of each experiment's run table (`run_table`), by the experiment's name.

    Args: `uri` is the store's address, `server` that of MLflow's UI. Experiments without runs are left out.
    """
    configure_mlflow()
    from mlflow.tracking import MlflowClient

    path = sqlite_path(uri)
    if path and not path.exists():
        return {}
    client = MlflowClient(tracking_uri=uri)
    found = [each for each in client.search_experiments() if client.search_runs([each.experiment_id], max_results=1)]
    return {each.name: run_table(server, each.experiment_id) for each in found}
