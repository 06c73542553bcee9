"""Python imports this at its start if this folder is on PYTHONPATH (the fixture `audited`).

Whenever a command adds a variable to its environment while other threads may read it, this writes a line to the file
that the variable AUDIT names: a new variable may move the environment while another thread is in `getenv`, which
crashes the process.
"""

import os
import sys
import threading

_known = set(os.environ)


def _hook(event: str, arguments: tuple) -> None:
    if event == "os.unsetenv":
        _known.discard(os.fsdecode(arguments[0]))
    elif event == "os.putenv" and (name := os.fsdecode(arguments[0])) not in _known:
        _known.add(name)
        # MLflow's thread does nothing but read from a pipe.
        threads = {thread.name for thread in threading.enumerate()} - {"MainThread", "mlflow"}
        if threads and os.path.basename(sys.argv[0]).startswith("gridsim-"):  # MLflow's process has a run's sys.argv
            with open(os.environ["AUDIT"], "a") as file:
                print(sys.argv[0], name, file=file)


sys.addaudithook(_hook)
