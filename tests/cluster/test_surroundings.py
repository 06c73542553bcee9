"""Where commands are started: terminals that close, users without a name or a home, notebooks; nothing may be lost."""

import fcntl
import os
import pty
import shutil
import signal
import subprocess
import tempfile
import termios
from pathlib import Path

import pytest
import tracked
from commands import BIN, all_in_mlflow, finish, rows, running, wait_until

from gridsim.jit import CACHE_FOLDER

SMALL = ["--scenario", "curved", "--traffic", "2", "--population", "48", "--generations", "30", "--seed", "5"]
pytestmark = pytest.mark.e2e


@pytest.mark.usefixtures("database")
def test_a_closed_terminal_stops_a_run_as_ctrl_c_does(tmp_path: Path) -> None:
    run, (ours, theirs) = tmp_path / "runs/r", pty.openpty()
    command = [str(BIN / "gridsim-evolve"), *SMALL, "--workers", "0", "--name", "r"]
    with subprocess.Popen(
        command,
        cwd=tmp_path,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    ) as process:
        os.close(theirs)
        try:
            wait_until(lambda: len(rows(run)) >= 2)
            os.close(ours)
            process.wait(60)
        finally:
            process.kill()
    assert process.returncode == 130
    (logged,) = (each.info for each in tracked.runs(f"sqlite:///{tmp_path}/mlflow.db") if each.info.run_name == "r")
    assert logged.status == "KILLED"
    assert len(rows(run)) < 30
    finish("gridsim-evolve", "--workers", "0", "--resume", "runs/r", cwd=tmp_path)
    assert len(rows(run)) == 30
    assert all_in_mlflow(run)


@pytest.mark.usefixtures("database")
def test_a_run_is_closed_when_what_reads_its_output_is_interrupted_with_it(tmp_path: Path) -> None:
    command = f"{BIN}/gridsim-evolve {' '.join(SMALL)} --generations 400 --workers 0 --name r 2>&1 | tee log"

    def status() -> str:
        found = tracked.runs(f"sqlite:///{tmp_path}/mlflow.db")
        return "".join(each.info.status for each in found if each.info.run_name == "r")

    with running("/bin/sh", "-c", command, cwd=tmp_path) as shell:
        wait_until(lambda: len(rows(tmp_path / "runs/r")) > 1 and status() == "RUNNING", pause=0.5)
        os.killpg(shell.pid, signal.SIGINT)
        wait_until(lambda: status() == "KILLED", 60, pause=0.5)


@pytest.mark.skipif(os.getuid() != 0, reason="becomes another user")
def test_neither_a_home_nor_a_users_name_is_needed(empty_database: Path) -> None:
    """As on OpenShift, with HTCondor, in systemd's units. It keeps root's right to read, as Python may lie in /root."""
    user = ["/usr/bin/setpriv", "--reuid", "54321", "--regid", "54321", "--clear-groups", "--no-new-privs"]
    user += ["--inh-caps", "+dac_read_search", "--ambient-caps", "+dac_read_search"]
    with tempfile.TemporaryDirectory(prefix="t-", dir="/tmp") as folder:
        shutil.copy(empty_database, folder)
        # The kernels, where such a user's are kept, so that they need not be compiled.
        shutil.copytree(CACHE_FOLDER, Path(folder, "gridsim-54321/gridsim", CACHE_FOLDER.name))
        subprocess.run(["chown", "-R", "54321", folder], check=True)
        command = [*user, "/usr/bin/env", "-i", f"PATH={os.environ['PATH']}", f"TMPDIR={folder}"]
        command.append(f"{BIN}/gridsim-evolve")
        assert finish(*command, "--help", cwd=folder).stdout.startswith("usage: gridsim-evolve")
        done = finish(*command, *SMALL, "--workers", "0", "--name", "r", cwd=folder)
        assert done.stderr == ""
        assert all_in_mlflow(Path(folder, "runs/r"))
