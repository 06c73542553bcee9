"""The process that sends a folder to MLflow, which `tracking.py` starts: `python -m cluster.tracking.sync`.

It syncs every few seconds: it sends what the folder has and MLflow lacks. It ends after the last sync, or as soon as
the process that started it has ended, however that did.
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
from typing import Any

from cluster.redaction import one_line
from cluster.tracking.address import is_database, is_locked
from cluster.tracking.database import silence_mlflow
from cluster.tracking.logged import LoggedRun, Status

SYNC_S = 2.0  # rows that come within this time go out as one request: 5 ms of CPU for a row alone, 0.8 ms among many
READ_SHARE = 0.02  # of a core that reading the folder takes at most: a long history is read less often
RETRY_S = 5.0  # after a sync that failed
LAST_RETRY_S = 1.0  # between the last syncs


def serve(order: dict[str, str], ends: SimpleQueue[Status], tell: Callable[[dict[str, Any]], None]) -> None:
    """Sync a folder until a status comes, then once or twice; a locked database is tried until we are killed.

    Args:
        order: `folder`, `uri`, `experiment`, and `read`, the function that reads the folder, as "module:name".
        tell: is told what is known of MLflow's run, and what it lacks, before and after a request.
    """
    folder, read = Path(order["folder"]), pkgutil.resolve_name(order["read"])
    run, status, error = LoggedRun(folder, order["uri"], order["experiment"]), None, None
    last_syncs = 0
    with contextlib.suppress(Exception):  # a sync raises it again
        import mlflow.tracking

        if is_database(order["uri"]):
            import mlflow.store.tracking.sqlalchemy_store  # noqa: F401
    while True:
        began = time.thread_time()
        try:
            content, lacking = read(folder), []
            if content:
                lacking = run.lacking(content, status)
        except Exception as failure:  # of a damaged folder; the run goes on
            content, lacking, error = None, ["what is new in its folder"], one_line(failure)
        read_s = time.thread_time() - began
        if content and (lacking or not run.run_id):
            tell({"lacking": lacking})
            error = run.send(content, status)
            lacking = run.lacking(content, status)
        elif not lacking:
            error = None
        ids = {"run_id": run.run_id, "experiment_id": run.experiment_id}
        tell({**ids, "sent": run.sent, "error": error, "lacking": lacking})
        last_syncs += status is not None
        if last_syncs and (error is None or (last_syncs > 1 and not is_locked(error))):
            return
        if last_syncs:
            time.sleep(LAST_RETRY_S)
        else:
            with contextlib.suppress(Empty):
                status = ends.get(timeout=RETRY_S if error else max(SYNC_S, read_s / READ_SHARE))


def main() -> None:
    """Serve the process that writes to our standard input: an order, then perhaps a status, each a line of JSON."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # a whole job may get them; we end after the run
        signal.signal(number, signal.SIG_IGN)
    gc.set_threshold(200_000, 20, 20)  # with Python's own thresholds, MLflow's import takes a sixth longer
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # for whatever prints
    silence_mlflow()
    order, ends = json.loads(sys.stdin.readline()), SimpleQueue[Status]()
    sys.argv[:] = order["argv"]  # of which MLflow keeps the command

    def listen() -> None:
        for line in sys.stdin:
            ends.put(json.loads(line))
        os._exit(1)  # the run was killed

    threading.Thread(target=listen, daemon=True).start()
    serve(order, ends, lambda known: print(json.dumps(known), file=answers))
    os._exit(0)  # the thread reads


if __name__ == "__main__":
    main()
