"""Two hosts on one machine, with a Ray cluster over both; `faults.py --cluster` disturbs them.

The first host is where this is called, which must be a network of its own (`unshare --net`); the second has another.
Both see the same files.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import psutil  # type: ignore[import-untyped]

BIN = Path(sys.executable).parent
START_S = 60.0


class Cluster:
    """Both hosts, connected to a switch, with one core each.

    Args:
        folder: a new one, of a short path, for Ray's files.
        environment: of Ray's processes.
    """

    address = "10.77.0.1:6379"

    def __init__(self, folder: Path, environment: dict[str, str]):
        self._folder, self._environment = folder, environment | {"RAY_TMPDIR": str(folder)}
        folder.mkdir()
        self._host = subprocess.Popen(["unshare", "--net", "sleep", "infinity"])
        while self._network(self._host.pid) == self._network(os.getpid()):
            time.sleep(0.01)
        self._enter = ["nsenter", "--target", str(self._host.pid), "--net"]
        self._ip("link", "add", "switch", "type", "bridge")
        self._ip("link", "add", "port", "type", "veth", "peer", "name", "eth0", "netns", str(self._host.pid))
        self._ip("link", "set", "port", "master", "switch", "up")
        for there, link, address in ([], "switch", "10.77.0.1/24"), (self._enter, "eth0", "10.77.0.2/24"):
            self._ip("address", "add", address, "dev", link, there=there)
            self._ip("link", "set", link, "up", there=there)
        self._ip("link", "set", "lo", "up", there=self._enter)
        self._nodes = [self._start([], "--head", "--node-ip-address", "10.77.0.1", "--include-dashboard", "false")]
        ends = time.monotonic() + START_S
        while time.monotonic() < ends:
            with contextlib.suppress(OSError), socket.create_connection(("10.77.0.1", 6379)):
                break
            time.sleep(0.2)
        self.mend()

    def processes(self) -> list[psutil.Process]:
        """All of the cluster's processes, its workers among them."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if process.environ().get("RAY_TMPDIR") == str(self._folder):
                    found.append(process)
        return found

    def mend(self) -> None:
        """Start the other host's Ray, unless it runs."""
        if len(self._nodes) < 2 or self._nodes[1].poll() is not None:
            self._nodes[1:] = [self._start(self._enter, "--address", self.address)]

    @contextlib.contextmanager
    def without_power(self) -> Iterator[None]:
        """Take the other host away for a while: at once, nothing is heard of its processes."""
        with self.unplugged():
            for process in psutil.process_iter():
                with contextlib.suppress(psutil.Error, OSError):
                    if process.pid != self._host.pid and self._network(process.pid) == self._network(self._host.pid):
                        process.kill()
            self._nodes[1].wait()
            yield

    @contextlib.contextmanager
    def unplugged(self) -> Iterator[None]:
        """Take the link down for a while; neither end is told."""
        self._ip("link", "set", "port", "down")
        try:
            yield
        finally:
            self._ip("link", "set", "port", "up")

    def close(self) -> None:
        """End both hosts."""
        for process in self.processes():
            with contextlib.suppress(psutil.Error):
                process.kill()
        self._host.kill()
        for each in (self._host, *self._nodes):
            each.wait()

    def _start(self, there: list[str], *flags: str) -> subprocess.Popen:
        command = [*there, str(BIN / "ray"), "start", "--block", "--num-cpus", "1", *flags]
        command += ["--object-store-memory", "200000000"]
        with (self._folder / "nodes.log").open("a") as log:
            return subprocess.Popen(command, env=self._environment, stdout=log, stderr=log, start_new_session=True)

    @staticmethod
    def _ip(*arguments: str, there: Sequence[str] = ()) -> None:
        subprocess.run([*there, "ip", *arguments], check=True)

    @staticmethod
    def _network(pid: int) -> str:
        return os.readlink(f"/proc/{pid}/ns/net")
