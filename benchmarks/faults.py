"""A campaign of faults: faults.py [--faults N] [--generations N] [--seed N] [--jobs N] [--workers N]
    [--cluster] [--json]

A small evolution runs again and again, with two Ray workers or with --workers 0 in one process, several of them at
once, beside an MLflow server of their own. At random moments one of FAULTS happens; a run that ended before its time is
started again. A run that came to its end must have the champion, the elites and the history of the undisturbed run, and
MLflow each of its rows once. When all runs are over, no process of theirs may be left, and no shared memory. 20 faults
take about three minutes, one run after another. The same seed draws the same faults, but not at the same steps of a
run.

A disk, and the shared memory in which Ray keeps its objects, are mounted for the campaign alone, so that they can be
filled; where that is not allowed, these two faults are left out. A clock that is set back is what `time.time` says in
all Python processes of a run; Ray's own waiting, like all of the system's, goes by clocks that cannot be set.

With --cluster the runs share a Ray cluster of two hosts with a core each, this one and one with a network of its own.
That one and the link to it fail, too; shared memory does not, as the cluster's first host would go with it.
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
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path

import psutil  # type: ignore[import-untyped]
from two_hosts import Cluster  # beside this file

BIN = Path(sys.executable).parent
SMALL = (  # 30 generations last for some time after Ray is up
    "--scenario", "curved", "--traffic", "2", "--population", "192", "--until", "2", "--seed", "5", "--generations",
)  # fmt: skip
PATIENCE_S = 10  # after which a silent worker is replaced
WORKER = "ray::Actor"  # how the names of workers' processes begin
MARK = "GRIDSIM_FAULTS"  # variable by which the processes of a campaign are found
DISK_MIB, SHARED_MIB = 256, 6144  # each run's Ray looks for 768 MiB of shared memory
SHARED_MEMORY = Path("/dev/shm")
CLOCK = """
import os, time
def seconds_back():
    with open(os.environ["CLOCK_FILE"]) as file:
        return int(file.read())
system, system_ns = time.time, time.time_ns
time.time = lambda: system() - seconds_back()
time.time_ns = lambda: system_ns() - 10**9 * seconds_back()
"""  # of a run's processes
MOUNTS = "GRIDSIM_FAULTS_MOUNTS"  # variable that is set where mounts are this campaign's own
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

    def __init__(self, folder: Path, seed: int, workers: int, generations: int, clustered: bool):
        self.workers, self.small = str(workers), (*SMALL, str(generations))
        self.seed, self.counts, self.finished, self.champions = seed, Counter[str](), 0, set[str]()
        self.shared = threading.Lock()  # held while the server or the disk, which all runs share, is disturbed
        self._numbers, self._stopped = count(), False
        self.disk = folder / "disk"
        self.disk.mkdir()
        missing = {"shared memory full"} if clustered else {"host gone", "link down"}
        if not workers:
            missing |= {"shared memory full", "worker killed", "worker stopped"}
        if MOUNTS in os.environ:
            for place, mib in (self.disk, DISK_MIB), (SHARED_MEMORY, SHARED_MIB):
                subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={mib}m", "none", str(place)], check=True)
        else:
            missing |= {"disk full", "shared memory full"}
        self.faults = [name for name in FAULTS if name not in missing]
        self.folder = folder
        (folder / "sitecustomize.py").write_text(CLOCK)
        self.environment = {
            **os.environ, MARK: str(folder), "RAY_TMPDIR": str(folder / "ray"), "PYTHONPATH": str(folder),
        }  # fmt: skip
        (folder / "ray").mkdir()
        self._shared_memory = set(os.listdir(SHARED_MEMORY))
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        self._server = self._start_server(port)
        self.gate = Gate(port)
        self.uri = f"http://127.0.0.1:{self.gate.port}"  # the server's, by way of the gate
        self.cluster = Cluster(folder / "nodes", dict(os.environ)) if clustered else None

    def _start_server(self, port: int) -> subprocess.Popen:
        command = [sys.executable, "-m", "mlflow", "server", "--workers", "1", "--host", "127.0.0.1"]
        command += ["--port", str(port)]
        command += ["--backend-store-uri", f"sqlite:///{self.folder}/served.db"]
        command += ["--artifacts-destination", f"{self.folder}/served"]
        environment = {**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false", "MLFLOW_DISABLE_TELEMETRY": "true"}
        with open(self.folder / "server.log", "w") as log:
            server = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        ends = time.monotonic() + LONG_S
        while time.monotonic() < ends:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port)):
                return server
            time.sleep(0.2)
        raise Wrong(f"the MLflow server does not come up: see {self.folder}/server.log")

    def close(self) -> None:
        """End the server and the cluster."""
        if self.cluster:
            self.cluster.close()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._server.pid, signal.SIGKILL)
        self._server.wait()

    # --------------------------------------------------------------------------------------------------------- runs

    def undisturbed(self) -> None:
        """A run without faults, in one process, with which all others are compared."""
        run = Run(self, "undisturbed")
        if run.start("--workers", "0", "--name", run.name, "--tracking-uri", self.uri, *self.small).wait(LONG_S):
            raise Wrong(f"the undisturbed run fails: {run.last_words()}")
        self.check(run.name)

    @property
    def happened(self) -> int:
        """Faults so far."""
        return sum(self.counts.values())

    def disturb(self, faults: int, tell: Callable[[], None]) -> None:
        """One run after another, until there were so many faults in all."""
        try:
            while self.happened < faults and not self._stopped:
                run = Run(self, f"run-{next(self._numbers)}")
                run.drive(faults)
                shutil.rmtree(self.disk / "runs" / run.name)
                self.finished += 1
                tell()
        finally:
            self._stopped = True  # the others end with their runs

    def check(self, name: str) -> None:
        """Whether a run is as the undisturbed one."""
        run, wanted = self.disk / "runs" / name, self.disk / "runs" / "undisturbed"
        summary, reference = (json.loads((folder / "summary.json").read_text()) for folder in (run, wanted))
        self.champions.add(summary["champion_sha256"])
        for figure in ("champion_sha256", "car_steps"):
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
        with contextlib.closing(sqlite3.connect(f"file:{self.folder}/served.db?mode=ro", uri=True)) as database:
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
        """Processes that runs of this campaign have started, and their workers on the cluster.

        Ray's agents, whose titles overwrite MARK, are known by their working folder, which is that of the runs.
        """
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                ours = process.environ().get(MARK) == str(self.folder) or Path(process.cwd()) == self.disk
                if ours and process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process)
        return found + self.workers_on_cluster()

    def workers_on_cluster(self) -> list[psutil.Process]:
        """The cluster's workers, of all runs."""
        found = []
        for process in self.cluster.processes() if self.cluster else ():
            with contextlib.suppress(psutil.Error):
                if process.name().startswith(WORKER):
                    found.append(process)
        return found

    def leftovers(self) -> dict[str, int]:
        """What is left when all runs are over."""
        self._wait_for_processes()
        return {
            "processes_left": len(self.processes()),
            "shared_memory_left": len(set(os.listdir(SHARED_MEMORY)) - self._shared_memory),
        }

    def _wait_for_processes(self) -> None:
        ends = time.monotonic() + 90.0
        while self.processes() and time.monotonic() < ends:
            time.sleep(1.0)


def history(run: Path) -> list[list[str]]:
    """What a run's history has that depends on no clock."""
    with (run / "history.csv").open(newline="") as file:
        return [[row[name] for name in SAME] for row in csv.DictReader(file)]


class Run:
    """One run, from its start to its end, resumed as often as that takes."""

    def __init__(self, campaign: Campaign, name: str):
        self.campaign, self.name = campaign, name
        self.rng = random.Random(f"{campaign.seed} {name}")
        self._said = campaign.folder / f"said-{name}.log"
        self._heard = 0  # bytes of it that are settled
        self._clock, self._seconds_back = campaign.folder / f"clock-{name}", 0
        self.set_clock_back(0)

    def set_clock_back(self, seconds: int) -> None:
        """Set the clock of the run's processes back; it stays so when the run is resumed."""
        self._seconds_back += seconds
        new = self._clock.with_suffix(".new")
        new.write_text(str(self._seconds_back))
        new.rename(self._clock)

    def start(self, *flags: str) -> subprocess.Popen:
        """`gridsim-evolve` with these flags, in a process group of its own."""
        command, campaign = [str(BIN / "gridsim-evolve"), *flags], self.campaign
        with open(self._said, "a") as said:
            return subprocess.Popen(
                command, cwd=campaign.disk, env={**campaign.environment, "CLOCK_FILE": str(self._clock)},
                stdout=subprocess.DEVNULL, stderr=said, process_group=0,
            )  # fmt: skip

    def drive(self, faults: int) -> None:
        """To its end, with faults until there were so many in all."""
        campaign = self.campaign
        flags = ["--name", self.name, "--resume-if-exists", "--tracking-uri", campaign.uri, *campaign.small]
        flags += ["--workers", campaign.workers, "--patience", str(PATIENCE_S)]
        if campaign.cluster:
            flags += ["--address", campaign.cluster.address]
        while True:
            if campaign.cluster:
                campaign.cluster.mend()
            process = self.start(*flags)
            ends, fault = time.monotonic() + LONG_S, self.rng.choice(campaign.faults)
            while process.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(self.rng.uniform(0.2, 5.0))
                if time.monotonic() > ends:
                    os.killpg(process.pid, signal.SIGKILL)
                    raise Wrong(f"{self.name} hangs; it last said: {self.last_words()}")
                waits = fault.startswith("worker") and not _workers(self, process)
                if not waits and process.poll() is None and campaign.happened < faults:
                    campaign.counts[fault] += 1
                    FAULTS[fault](self, process)
                    fault = self.rng.choice(campaign.faults)
            if process.returncode == 0:
                break
            refused = process.returncode == 2 and "no MLflow server" in self.said()  # a new run looks for it first
            outside = process.returncode in (-signal.SIGINT, -signal.SIGTERM) and "in _enter" not in self.said()
            if outside:  # Python itself was interrupted, before the command began
                self._heard = self._said.stat().st_size
                continue
            known = process.returncode in (-signal.SIGKILL, -signal.SIGBUS, 130, 1)  # SIGBUS: shared memory was full
            if "Traceback" in self.said() or not (refused or known):
                raise Wrong(f"{self.name} ends with {process.returncode}: {self.last_words()}")
        with campaign.shared:
            unsent = re.search("not logged to MLflow|could not upload to MLflow", self.said())
            if unsent and self.start(*flags).wait(LONG_S):
                raise Wrong(f"{self.name} cannot be sent later: {self.last_words()}")
            campaign.check(self.name)

    def said(self) -> str:
        """What its commands wrote to the terminal's error stream."""
        return self._said.read_bytes()[self._heard :].decode()

    def last_words(self) -> str:
        """The end of it."""
        return self.said()[-500:].strip().replace("\n", " | ")


# ------------------------------------------------------------------------------------------------------------- faults


def _workers(run: Run, process: subprocess.Popen) -> list[psutil.Process]:
    with contextlib.suppress(psutil.Error):
        below = psutil.Process(process.pid).children(recursive=True)
        own = [child for child in below if child.is_running() and child.name().startswith(WORKER)]
        return own + run.campaign.workers_on_cluster()
    return []


def _signal_a_worker(run: Run, process: subprocess.Popen, number: int) -> None:
    with contextlib.suppress(psutil.Error, IndexError):  # all have ended by now
        run.rng.choice(_workers(run, process)).send_signal(number)


def _signal_group(process: subprocess.Popen, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)


def _mlflow(mode: str, run: Run) -> None:
    with run.campaign.shared, run.campaign.gate.shut(mode):
        time.sleep(run.rng.uniform(0.5, 8.0))


def _fill(folder: Path, run: Run, process: subprocess.Popen) -> None:
    ballast = folder / "ballast"
    with run.campaign.shared:
        try:
            with contextlib.suppress(OSError), ballast.open("wb") as file:
                while True:
                    file.write(bytes(1 << 20))
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(run.rng.uniform(0.5, 4.0))
        finally:
            ballast.unlink(missing_ok=True)


def _lose_host(run: Run) -> None:
    assert run.campaign.cluster
    with run.campaign.cluster.without_power():
        time.sleep(run.rng.uniform(0.0, 20.0))
    run.campaign.cluster.mend()


def _unplug(run: Run) -> None:
    assert run.campaign.cluster
    with run.campaign.cluster.unplugged():
        time.sleep(run.rng.uniform(0.5, 40.0))
    run.campaign.cluster.mend()


FAULTS: dict[str, Callable[[Run, subprocess.Popen], None]] = {
    "worker killed": lambda run, process: _signal_a_worker(run, process, signal.SIGKILL),
    "worker stopped": lambda run, process: _signal_a_worker(run, process, signal.SIGSTOP),
    "coordinator killed": lambda _, process: process.kill(),
    "coordinator terminated": lambda _, process: process.terminate(),
    "group terminated": lambda _, process: _signal_group(process, signal.SIGTERM),
    "group interrupted": lambda _, process: _signal_group(process, signal.SIGINT),
    "MLflow gone": lambda run, _: _mlflow("gone", run),
    "MLflow slow": lambda run, _: _mlflow("slow", run),
    "MLflow full": lambda run, _: _mlflow("full", run),
    "disk full": lambda run, process: _fill(run.campaign.disk, run, process),
    "shared memory full": lambda run, process: _fill(SHARED_MEMORY, run, process),
    "clock set back": lambda run, _: run.set_clock_back(run.rng.randint(1, 86_400)),
    "host gone": lambda run, _: _lose_host(run),
    "link down": lambda run, _: _unplug(run),
}


def main() -> int:
    """Run it; 1 if a run did not survive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=20, help="how many (20)")
    parser.add_argument("--generations", type=int, default=30, help="of each run (30)")
    parser.add_argument("--seed", type=int, default=0, help="of the faults and their moments (0)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at once (1)")
    parser.add_argument("--workers", type=int, default=2, help="Ray workers of a run; 0: in one process (2)")
    parser.add_argument("--cluster", action="store_true", help="on two hosts; one run at a time")
    parser.add_argument("--json", action="store_true", help="print one flat JSON object and nothing else")
    options = parser.parse_args()
    if options.cluster and (options.jobs > 1 or not options.workers):
        parser.error("--cluster has one run at a time, with workers: leave --jobs and --workers out")
    own = ["unshare", "--mount", *(["--net"] if options.cluster else [])]
    can = shutil.which(own[0]) and not subprocess.run([*own, "true"], stderr=subprocess.DEVNULL).returncode
    if options.cluster and not (can and shutil.which("ip")):
        parser.error("--cluster needs root, unshare and ip (packages util-linux and iproute2)")
    if can and MOUNTS not in os.environ:
        os.execvpe(own[0], [*own, sys.executable, *sys.argv], {**os.environ, MOUNTS: "1"})
    if options.cluster:
        subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # runs inherit it; jobs in a shell's background ignore it
    folder = Path(tempfile.mkdtemp(prefix="gsf", dir="/tmp"))  # Ray's sockets need a short path
    campaign, wrong = Campaign(folder, options.seed, options.workers, options.generations, options.cluster), ""
    begun = time.monotonic()
    try:
        campaign.undisturbed()

        def tell() -> None:
            if not options.json:
                done = f"{campaign.happened} of {options.faults} faults, {campaign.finished} runs"
                print(f"{done}, {time.monotonic() - begun:.0f} s", flush=True)

        with ThreadPoolExecutor(options.jobs) as jobs:
            list(jobs.map(lambda _: campaign.disturb(options.faults, tell), range(options.jobs)))
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
    if wrong or any(left.values()):
        print(f"{wrong or 'something is left'}\nits files: {folder}", file=sys.stderr)
        return 1
    shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
