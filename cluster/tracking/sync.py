"""The process that `tracking.py` starts to send a folder to MLflow: `python -m cluster.tracking.sync`.

It syncs every few seconds: it sends what the folder has and MLflow lacks. It ends after the last sync, or as soon as
the process that started it has ended, even if that was killed.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import pkgutil
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TextIO

from cluster.redaction import one_line
from cluster.tracking.address import is_database, is_locked
from cluster.tracking.database import configure_mlflow
from cluster.tracking.logged import LoggedRun, Status

SYNC_S = 2.0  # from a sync to the next; rows of this time share a request: 0.8 ms of CPU each, 5 ms for one alone
RETRY_S = 5.0  # from a sync that failed to the next
LAST_RETRY_S = 1.0  # between syncs after the run has ended


def serve(orders: TextIO, answers: TextIO, at_eof: Callable[[], None]) -> None:
    """Sync a folder until a status comes, then once more, or twice if that fails.

    While others lock the database, more of these last syncs follow, until the process is killed.

    Args:
        orders: a line of JSON with `folder`, `uri`, `experiment`, `argv`, and `read`, the function that reads the
            folder, as "module:name"; later perhaps one with a status.
        answers: gets lines of JSON: the ids of MLflow's run and experiment, what was sent, the last error, and what
            MLflow lacks.
        at_eof: is called in a thread when `orders` ends, as it does when the run's process has ended.
    """
    order, ends = json.loads(orders.readline()), SimpleQueue[Status]()
    sys.argv[:] = order["argv"]  # MLflow records these as the run's command

    def listen() -> None:
        for line in orders:
            ends.put(json.loads(line))
        at_eof()

    def tell() -> None:
        ids = {"run_id": run.run_id, "experiment_id": run.experiment_id}
        print(json.dumps({**ids, "sent": run.sent, "error": error, "lacking": lacking}), file=answers)

    threading.Thread(target=listen, daemon=True).start()
    import mlflow.tracking  # takes seconds, in which the run goes on

    if is_database(order["uri"]):
        import mlflow.store.tracking.sqlalchemy_store  # noqa: F401
    from mlflow.utils.requirements_utils import warn_dependency_requirement_mismatches

    # Before MLflow saves its first model, it lists the installed packages, for 0.3 s. Do it now, while the run goes on.
    warn_dependency_requirement_mismatches(["mlflow"])
    folder, read = Path(order["folder"]), pkgutil.resolve_name(order["read"])
    run = LoggedRun(folder, order["uri"], order["experiment"])
    status, error, last_syncs = None, None, 0
    while True:
        try:
            content = read(folder)
            lacking = run.lacking(content, status) if content else []
        except Exception as failure:  # the folder is damaged; the run goes on
            content, lacking, error = None, ["what is new in its folder"], one_line(failure)
        if content and (lacking or not run.run_id):
            tell()
            error = run.send(content, status)
            lacking = run.lacking(content, status)
        elif not lacking:
            error = None
        tell()
        last_syncs += status is not None
        if last_syncs and (error is None or (last_syncs > 1 and not is_locked(error))):
            return
        if last_syncs:
            time.sleep(LAST_RETRY_S)
        else:
            with contextlib.suppress(Empty):
                status = ends.get(timeout=RETRY_S if error else SYNC_S)


def main() -> None:
    """Serve the process that writes to our standard input."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # a whole job may get them; we end after the run
        signal.signal(number, signal.SIG_IGN)
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what MLflow prints must not come between the answers
    configure_mlflow()
    gc.set_threshold(200_000, 20, 20)  # with Python's own thresholds, MLflow's import takes a sixth longer
    serve(sys.stdin, answers, lambda: os._exit(1))
    os._exit(0)  # the thread that reads `stdin` would not end


if __name__ == "__main__":
    main()
