"""`make ui`: MLflow's UI on loopback; links to its run tables are printed once it answers."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time

from cluster.redaction import one_line
from cluster.tracking.address import DEFAULT_URI, TrackingError, check_uri, reach_loopback_directly, unreachable
from cluster.tracking.database import run_tables

STOP_S = 10.0  # s that the server may take to end


def main(port: str) -> None:
    """Show the runs in `mlflow.db` of the working directory, until Ctrl-C."""
    reach_loopback_directly()
    address = f"http://127.0.0.1:{port}"
    try:
        socket.create_server(("127.0.0.1", int(port))).close()
        print("starting MLflow's UI, which takes some seconds ...", flush=True)
        tables = run_tables(check_uri(DEFAULT_URI), address)
    except TrackingError as error:
        sys.exit(f"make ui: {error}")
    except (OSError, OverflowError, ValueError):
        sys.exit(f"make ui: port {port} is in use or not a port; choose another with make ui PORT=...")
    except Exception as error:  # a database of another MLflow version
        sys.exit(f"make ui: {DEFAULT_URI}: {one_line(error)}; move it elsewhere if another MLflow made it")
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # under nohup, SIGHUP stays ignored
            signal.signal(number, signal.default_int_handler)
    command = ["ui", "--backend-store-uri", DEFAULT_URI, "--host", "127.0.0.1", "--port", port, "--workers", "2"]
    server = subprocess.Popen(
        [sys.executable, "-m", "mlflow", *command, "--uvicorn-opts", "--log-level warning"],
        env={**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "PYTHONWARNINGS": "ignore"},
        process_group=0,  # Ctrl-C reaches only this process, which then ends the server's whole group
    )
    try:
        while server.poll() is None and unreachable(address):
            time.sleep(0.2)
        if server.poll() is None:
            links = [f"runs of {name}: {table}" for name, table in tables.items()]
            links = links or ["there are no runs yet: make evolve makes one"]
            print(f"MLflow's UI on {address}; Ctrl-C ends it", *links, sep="\n", flush=True)
        sys.exit(server.wait())
    except KeyboardInterrupt:
        pass
    finally:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
        with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
            os.killpg(server.pid, signal.SIGTERM)
            server.wait(STOP_S)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(server.pid, signal.SIGKILL)


if __name__ == "__main__":
    main(sys.argv[1])
