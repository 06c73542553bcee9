"""A campaign of faults: python benchmarks/faults.py [--faults N] [--seed N] [--json]

A small evolution with two workers runs again and again, beside an MLflow server of its own. At random moments one of
FAULTS happens; a run that ended before its time is resumed. A run that came to its end must have the champion, the
elites and the history of the undisturbed run, and MLflow each of its rows once. When all runs are over, no process of
theirs may be left, and no file that is no result. 20 faults take about three minutes. The same seed draws the same
faults, but not at the same steps of a run.

To fill a disk, a small one is mounted for the runs; where that is not allowed, that fault is left out. Hosts and their
links fail in tests/cluster/test_cluster.py and test_faults.py.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import random
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import psutil  # type: ignore[import-untyped]

BIN = Path(sys.executable).parent
SMALL = (
    "--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", "10", "--until", "2",
    "--seed", "5",
)  # fmt: skip
PATIENCE_S = 10  # after which a silent worker is replaced
MARK = "GRIDSIM_FAULTS"  # variable by which the processes of a campaign are found
DISK_MIB = 256
LONG_S = 300.0  # that anything may take
SAME = ("fitness/best", "fitness/mean", "distance_m/mean", "car_steps", "leader/success_rate")  # columns of the history


class Wrong(Exception):
    """A run did not survive its faults as it should."""


class Gate:
    """A TCP proxy before the MLflow server: open, gone, slow, or answering that the server is full."""

    def __init__(self, port: int):
        self._server_port, self.mode = port, "open"
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=64)
        self.port = self._listener.getsockname()[1]
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    @contextlib.contextmanager
    def shut(self, mode: str) -> Iterator[None]:
        """Another mode for a while. Connections are cut as it begins, in the middle of whatever they do."""
        self.mode = mode
        for connection in self._open:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._open.clear()
        try:
            yield
        finally:
            self.mode = "open"

    def _accept(self) -> None:
        while True:
            client, _ = self._listener.accept()
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError), client:
            if self.mode == "gone":
                return
            if self.mode == "full":
                client.recv(1 << 16)
                client.sendall(b"HTTP/1.1 507 Insufficient Storage\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
                return
            if self.mode == "slow":
                time.sleep(2.0)
            with socket.create_connection(("127.0.0.1", self._server_port)) as server:
                self._open += [client, server]
                back = threading.Thread(target=self._copy, args=(server, client), daemon=True)
                back.start()
                self._copy(client, server)
                back.join()

    @staticmethod
    def _copy(source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while part := source.recv(1 << 16):
                target.sendall(part)
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


class Campaign:
    """The runs, their server, and what happens to them. `folder` is a new one, of a short path."""

    def __init__(self, folder: Path, seed: int):
        self.rng, self.counts, self.finished, self.champions = random.Random(seed), Counter[str](), 0, set[str]()
        self.disk = folder / "disk"
        self.disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "none", str(self.disk)]
        self.mounted = (
            shutil.which("mount") is not None and not subprocess.run(mount, stderr=subprocess.DEVNULL).returncode
        )
        self.faults = [name for name in FAULTS if self.mounted or name != "disk full"]
        self._folder = folder
        self._environment = {**os.environ, MARK: str(folder), "RAY_TMPDIR": str(folder / "ray")}
        (folder / "ray").mkdir()
        self._shared_memory = set(os.listdir("/dev/shm"))
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self._server = self._start_server(port)
        self.gate = Gate(port)

    def _start_server(self, port: int) -> subprocess.Popen:
        command = [
            sys.executable,
            "-m",
            "mlflow",
            "server",
            "--workers",
            "1",
            "--host",
            "127.0.0.1",
            "--port",
            str(port),
        ]
        command += ["--backend-store-uri", f"sqlite:///{self._folder}/served.db"]
        command += ["--artifacts-destination", f"{self._folder}/served"]
        environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
        with open(self._folder / "server.log", "w") as log:
            server = subprocess.Popen(
                command, cwd=self._folder, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        ends = time.monotonic() + LONG_S
        while time.monotonic() < ends:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                return server
            time.sleep(0.2)
        raise Wrong(f"the MLflow server does not come up: see {self._folder}/server.log")

    def close(self) -> None:
        """End the server and unmount the disk."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._server.pid, signal.SIGKILL)
        self._server.wait()
        if self.mounted:
            subprocess.run(["umount", "--lazy", str(self.disk)], check=False)

    # --------------------------------------------------------------------------------------------------------- runs

    def start(self, *flags: str) -> subprocess.Popen:
        """`gridsim-evolve` with these flags, in a process group of its own."""
        command = [str(BIN / "gridsim-evolve"), *flags]
        with open(self._folder / "said.log", "a") as said:
            return subprocess.Popen(
                command, cwd=self.disk, env=self._environment, stdout=subprocess.DEVNULL, stderr=said, process_group=0
            )

    def undisturbed(self) -> None:
        """The run that all others are compared with."""
        uri = f"http://127.0.0.1:{self.gate.port}"
        process = self.start("--workers", "2", "--name", "undisturbed", "--tracking-uri", uri, *SMALL)
        if process.wait(LONG_S):
            raise Wrong(f"the undisturbed run fails: {self.last_words()}")
        self._check("undisturbed")

    @property
    def happened(self) -> int:
        """Faults so far."""
        return sum(self.counts.values())

    def run(self, number: int, faults: int) -> None:
        """One run to its end, with faults until there were so many in all."""
        name, begun = f"run-{number}", 0
        uri = f"http://127.0.0.1:{self.gate.port}"
        resumable = self.disk / "runs" / name / "checkpoint.npz"
        while True:
            if resumable.exists():
                process = self.start("--workers", "2", "--patience", str(PATIENCE_S), "--resume", f"runs/{name}")
            else:
                begun += 1
                name = f"run-{number}-{begun}"  # a run killed before its first checkpoint keeps the name
                resumable = self.disk / "runs" / name / "checkpoint.npz"
                flags = ("--patience", str(PATIENCE_S), "--name", name, "--tracking-uri", uri)
                process = self.start("--workers", "2", *flags, *SMALL)
            ends = time.monotonic() + LONG_S
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(self.rng.uniform(0.2, 5.0))
                if time.monotonic() > ends:
                    os.killpg(process.pid, signal.SIGKILL)
                    raise Wrong(f"{name} hangs; it last said: {self.last_words()}")
                if process.poll() is None and self.happened < faults:
                    fault = self.rng.choice(self.faults)
                    self.counts[fault] += 1
                    FAULTS[fault](self, process)
            if process.returncode == 0:
                break
            refused = process.returncode == 2 and "no MLflow server" in self.said()  # a new run looks for it first
            if "Traceback" in self.said() or not (refused or process.returncode in (-signal.SIGKILL, 130, 1)):
                raise Wrong(f"{name} ends with {process.returncode}: {self.last_words()}")
        unsent = re.search("not logged to MLflow|what MLflow lacks is not sent", self.said())
        if unsent and self.start("--resume", f"runs/{name}").wait(LONG_S):
            raise Wrong(f"{name} cannot be sent later: {self.last_words()}")
        self._check(name)
        shutil.rmtree(self.disk / "runs" / name)
        (self._folder / "said.log").write_text("")
        self.finished += 1

    def said(self) -> str:
        """What the commands of this run wrote to the terminal's error stream."""
        return (self._folder / "said.log").read_text()

    def last_words(self) -> str:
        """The end of it."""
        return self.said()[-500:].strip().replace("\n", " | ")

    def _check(self, name: str) -> None:
        run, wanted = self.disk / "runs" / name, self.disk / "runs" / "undisturbed"
        summary, reference = (json.loads((folder / "summary.json").read_text()) for folder in (run, wanted))
        self.champions.add(summary["champion_sha256"])
        for figure in ("champion_sha256", "car_steps", "lost_chunks"):
            if summary[figure] != reference[figure]:
                raise Wrong(f"{name}: {figure} is {summary[figure]}, undisturbed {reference[figure]}")
        if (run / "elites.npz").read_bytes() != (wanted / "elites.npz").read_bytes():
            raise Wrong(f"{name}: its elites differ from the undisturbed run's")
        if history(run) != history(wanted):
            raise Wrong(f"{name}: its history differs from the undisturbed run's")
        left = [path for path in run.rglob("*") if path.name.startswith(".") or path.suffix in (".tmp", ".part")]
        if left:
            raise Wrong(f"{name} leaves {left[0]}")
        steps = range(int(summary["generations"]))
        with contextlib.closing(sqlite3.connect(f"file:{self._folder}/served.db?mode=ro", uri=True)) as database:
            found = database.execute("SELECT run_uuid, status FROM runs WHERE name = ?", (name,)).fetchall()
            if [status for _, status in found] != ["FINISHED"]:
                raise Wrong(f"{name}: MLflow has it as {found}")
            for metric in SAME:
                rows = database.execute(
                    "SELECT step FROM metrics WHERE run_uuid = ? AND key = ? ORDER BY step", (found[0][0], metric)
                ).fetchall()
                if [step for (step,) in rows] != list(steps):
                    raise Wrong(f"{name}: of {metric} MLflow has the steps {[step for (step,) in rows]}")

    # ----------------------------------------------------------------------------------------------------- leftovers

    def processes(self) -> list[psutil.Process]:
        """Processes that runs of this campaign have started."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if process.environ().get(MARK) == str(self._folder) and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found

    def leftovers(self) -> dict[str, int]:
        """What is left when all runs are over. Ray's helpers look for a killed coordinator for a minute."""
        ends = time.monotonic() + 90.0
        while self.processes() and time.monotonic() < ends:
            time.sleep(1.0)
        return {
            "processes_left": len(self.processes()),
            "shared_memory_left": len(set(os.listdir("/dev/shm")) - self._shared_memory),
            "ray_sessions_left": len(list((self._folder / "ray").glob("**/session_2*"))),
        }


def history(run: Path) -> list[list[str]]:
    """What a run's history has that depends on no clock."""
    with (run / "history.csv").open(newline="") as file:
        return [[row[name] for name in SAME] for row in csv.DictReader(file)]


# ------------------------------------------------------------------------------------------------------------- faults


def _workers(process: subprocess.Popen) -> list[psutil.Process]:
    with contextlib.suppress(psutil.Error):
        below = psutil.Process(process.pid).children(recursive=True)
        return [child for child in below if child.is_running() and child.name().startswith("ray::Actor")]
    return []


def _signal_a_worker(campaign: Campaign, process: subprocess.Popen, number: int) -> None:
    if workers := _workers(process):
        with contextlib.suppress(psutil.Error):
            campaign.rng.choice(workers).send_signal(number)


def _kill_worker(campaign: Campaign, process: subprocess.Popen) -> None:
    _signal_a_worker(campaign, process, signal.SIGKILL)


def _stop_worker(campaign: Campaign, process: subprocess.Popen) -> None:
    _signal_a_worker(campaign, process, signal.SIGSTOP)


def _kill_coordinator(campaign: Campaign, process: subprocess.Popen) -> None:
    process.kill()


def _end_coordinator(campaign: Campaign, process: subprocess.Popen) -> None:
    process.terminate()


def _end_group(campaign: Campaign, process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)


def _interrupt_group(campaign: Campaign, process: subprocess.Popen) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGINT)


def _mlflow(mode: str, campaign: Campaign) -> None:
    with campaign.gate.shut(mode):
        time.sleep(campaign.rng.uniform(0.5, 8.0))


def _fill_disk(campaign: Campaign, process: subprocess.Popen) -> None:
    ballast = campaign.disk / "ballast"
    try:
        with contextlib.suppress(OSError), ballast.open("wb") as file:
            while True:
                file.write(bytes(1 << 20))
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(campaign.rng.uniform(0.5, 4.0))
    finally:
        ballast.unlink(missing_ok=True)


FAULTS = {
    "worker killed": _kill_worker,
    "worker stopped": _stop_worker,
    "coordinator killed": _kill_coordinator,
    "coordinator terminated": _end_coordinator,
    "group terminated": _end_group,
    "group interrupted": _interrupt_group,
    "MLflow gone": lambda campaign, _: _mlflow("gone", campaign),
    "MLflow slow": lambda campaign, _: _mlflow("slow", campaign),
    "MLflow full": lambda campaign, _: _mlflow("full", campaign),
    "disk full": _fill_disk,
}


def main() -> int:
    """Run it; 1 if a run did not survive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=20, help="how many (20)")
    parser.add_argument("--seed", type=int, default=0, help="of the faults and their moments (0)")
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    options = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # runs inherit it; jobs in a shell's background ignore it
    folder = Path(tempfile.mkdtemp(prefix="gsf", dir="/tmp"))  # Ray's sockets need a short path
    campaign, wrong = Campaign(folder, options.seed), ""
    begun = time.monotonic()
    try:
        campaign.undisturbed()
        while campaign.happened < options.faults:
            campaign.run(campaign.finished, options.faults)
            if not options.json:
                seconds = time.monotonic() - begun
                print(
                    f"{campaign.happened} of {options.faults} faults, {campaign.finished} runs, {seconds:.0f} s",
                    flush=True,
                )
    except Wrong as error:
        wrong = str(error)
    finally:
        for process in campaign.processes() if wrong else []:
            process.kill()
        left = campaign.leftovers()
        campaign.close()
    figures = {
        "faults": campaign.happened,
        "runs": campaign.finished,
        "champions": len(campaign.champions),
        "seconds": round(time.monotonic() - begun),
        **left,
        **{name.replace(" ", "_"): campaign.counts[name] for name in campaign.faults},
    }
    if options.json:
        print(json.dumps(figures))
    else:
        for name, number in figures.items():
            print(f"{name:24} {number:6,}")
    if wrong:
        print(f"{wrong}\nits files: {folder}", file=sys.stderr)
        return 1
    shutil.rmtree(folder, ignore_errors=True)
    return 1 if left["processes_left"] or left["shared_memory_left"] else 0


if __name__ == "__main__":
    sys.exit(main())
