"""Real hosts on one machine: each has network, processes, /tmp, home and SSH server of its own.

A host is a process in namespaces of its own (`unshare`). Its first process reads from a pipe that only we hold: when we
end, however that is, it ends too, and the kernel removes the host's processes, mounts and network with it.
"""

import os
import pwd
import shutil
import site
import subprocess
import sys
from collections.abc import Collection
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from subprocess import PIPE, STDOUT
from typing import Any

from commands import command_line, descendants, wait_until

HOME = Path(pwd.getpwuid(os.geteuid()).pw_dir)
PROGRAMS = ("unshare", "nsenter", "ip", "ss", "sshd", "ssh", "ssh-keygen", "rsync", "uptime")  # `ray up` calls the last
SEARCH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
# What a shell starts with on a host.
ENVIRONMENT = {"HOME": str(HOME), "PATH": SEARCH, "LANG": "C.UTF-8", "TERM": "dumb", "RAY_USAGE_STATS_ENABLED": "0"}
UNSHARE = ["unshare", "--net", "--pid", "--fork", "--mount", "--mount-proc"]

# Arguments: the host's folder, the home to replace, what to keep (up to --), what to hide.
SETUP = """
set -e
folder=$1 home=$2; shift 2
keep=(); while [ "$1" != -- ]; do keep+=("$1"); shift; done; shift
replace() {  # a directory by one of the host's own, in which what is kept lies where it was
  for path in "${keep[@]}"; do
    case $path/ in "$1"/*) mkdir -p "$2${path#"$1"}"; mount --bind "$path" "$2${path#"$1"}";; esac
  done
  mount --rbind "$2" "$1"
}
replace /tmp "$folder/tmp"
replace "$home" "$folder/home"
for path in "$@"; do mount -t tmpfs none "$path"; done
mount -t tmpfs none /run
mkdir /run/sshd
printf 'root:*:19000:0:99999:7:::\\n' > "$folder/shadow"  # sshd lets nobody in whose account is locked
mount --bind "$folder/shadow" /etc/shadow
ip link set lo up
echo ready
read -r _ || true
"""


def missing() -> str:
    """Why there can be no hosts here; empty where there can."""
    if os.geteuid() != 0:
        return "needs root, for network namespaces"
    if lacking := [name for name in PROGRAMS if not shutil.which(name, path=SEARCH)]:
        return f"needs {', '.join(lacking)}"
    done = subprocess.run([*UNSHARE, "true"], capture_output=True)
    return "" if done.returncode == 0 else "needs leave to make namespaces (in Docker: --privileged)"


def package_folders() -> set[str]:
    """Where this project's packages are found: in the checkout, and where they are installed."""
    places = [Path(__file__).parents[2], *map(Path, site.getsitepackages())]
    folders = [place / name for place in places for name in ("cluster", "evolution", "gridsim")]
    return {str(folder) for folder in folders if folder.exists()}


def folders_of(distributions: Collection[str]) -> set[str]:
    """The folders of modules that distributions of other projects have installed."""
    files = [file for name in distributions for file in metadata.files(name) or () if len(file.parts) > 1]
    folders = {str(Path(str(file.locate())).parents[len(file.parts) - 2]) for file in files if file.parts[0] != ".."}
    return {name for name in folders if not name.endswith(("-info", "__pycache__")) and os.path.isdir(name)}


@dataclass
class Command:
    process: subprocess.Popen[bytes]
    log: Path

    def finish(self, timeout: float, code: int = 0) -> str:
        """Wait for its end, which has to be with that exit code; returns its output, errors included."""
        try:
            self.process.wait(timeout)
        finally:
            self.process.kill()
            self.process.wait()
            output = self.log.read_text(errors="replace")
        assert self.process.returncode == code, f"{self.process.args!r} ended with {self.process.returncode}:\n{output}"
        return output


class Host:
    """One machine. `folder`, a new one, holds what its disk is from the outside: tmp, home. Paths to `keep` are the
    same on each host (the checkout, Python); folders to `hide` are empty on this one."""

    def __init__(self, folder: Path, keep: list[Path], hide: Collection[str] = ()):
        self.folder, self.home = folder, folder / "home"
        for part in ("tmp", "home/.ssh", "logs"):
            (folder / part).mkdir(parents=True)
        (folder / "tmp").chmod(0o1777)
        (folder / "home").chmod(0o700)
        (self.home / ".gridsim").symlink_to(sys.prefix)
        self.address = ""
        self._logs = 0
        arguments = [folder, HOME, *keep, folder, "--", *sorted(hide)]
        self._process = subprocess.Popen(
            [*UNSHARE, "--uts", "--kill-child", "bash", "-c", SETUP, "host", *map(str, arguments)],
            stdin=PIPE, stdout=PIPE, stderr=STDOUT, env=ENVIRONMENT,
        )  # fmt: skip
        assert self._process.stdout
        said = list[bytes]()
        while (line := self._process.stdout.readline()) not in (b"ready\n", b""):
            said.append(line)
        assert line, f"the host could not be set up: {b''.join(said).decode()}"
        self.pid = descendants(self._process.pid)[0]

    def start(self, *command: object, cwd: object = HOME, **environment: str) -> Command:
        """A command there; keywords are set in its environment."""
        self._logs += 1
        log = self.folder / "logs" / f"{self._logs}"
        shell = ["bash", "-c", 'cd "$1" && shift && exec "$@"', "shell", cwd, *command]
        entered = [*self._enter("--pid", "--mount", "--uts"), *map(str, shell)]
        with log.open("wb") as output:
            process = subprocess.Popen(
                entered, stdin=subprocess.DEVNULL, stdout=output, stderr=STDOUT, env=ENVIRONMENT | environment
            )
        return Command(process, log)

    def run(self, *command: object, timeout: float = 60.0, **options: Any) -> str:
        """A command there, run to its end, which has to be a good one; returns its output."""
        return self.start(*command, **options).finish(timeout)

    def _enter(self, *namespaces: str) -> list[str]:
        return ["nsenter", "--target", str(self.pid), "--net", *namespaces]

    def connect(self, switch: "Host", address: str) -> None:
        """Put a cable between this host and a switch, and give the host an address of 24 bits."""
        port = f"p{address.rpartition('.')[2]}"
        cable = ["ip", "link", "add", port, "type", "veth", "peer", "name", "eth0", "netns", str(self.pid)]
        subprocess.run([*switch._enter(), *cable], check=True)
        switch.run("ip", "link", "set", port, "master", "switch", "up")
        self.run("ip", "address", "add", f"{address}/24", "dev", "eth0")
        self.run("ip", "link", "set", "eth0", "up")
        self.run("ip", "route", "add", "default", "dev", "eth0")  # by it Ray finds out its address
        self.address = address

    def serve_ssh(self, authorized: str) -> None:
        (self.home / ".ssh" / "authorized_keys").write_text(authorized)
        self.run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", HOME / ".ssh/host")
        options = (
            f"HostKey={HOME}/.ssh/host ListenAddress={self.address} PasswordAuthentication=no "
            "PermitRootLogin=prohibit-password PidFile=none StrictModes=no UsePAM=no"
        )
        flags = [flag for option in options.split() for flag in ("-o", option)]
        self.run(shutil.which("sshd", path=SEARCH), "-f", "/dev/null", "-E", "/tmp/sshd.log", *flags)

    def processes(self) -> list[str]:
        return [command_line(pid) for pid in descendants(self.pid)]

    def listening(self) -> dict[int, set[str]]:
        """Ports that TCP connections are waited for at, and the addresses that they can be made to."""
        ports: dict[int, set[str]] = {}
        for line in self.run("ss", "-Hltn").splitlines():
            address, _, port = line.split()[3].rpartition(":")
            ports.setdefault(int(port), set()).add(address.partition("%")[0])
        return ports

    def close(self) -> None:
        """Pull the mains plug."""
        self._process.kill()
        self._process.communicate()
        wait_until(lambda: not os.path.exists(f"/proc/{self.pid}"), 30)


def switch(folder: Path, keep: list[Path]) -> Host:
    """A host with a network switch, at 10.77.0.1; the others are connected to it."""
    host = Host(folder, keep)
    host.run("ip", "link", "add", "switch", "type", "bridge")
    host.run("ip", "address", "add", "10.77.0.1/24", "dev", "switch")
    host.run("ip", "link", "set", "switch", "up")
    return host
