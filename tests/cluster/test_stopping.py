"""What signals do: the first sets a flag, a second ends the process at once."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import start, wait_until

from cluster import stopping

LISTEN = """
import sys, time
from cluster import stopping
stopping.listen()
print("begun", flush=True)
while not stopping.requested():
    time.sleep(0.01)
print("asked", flush=True)
time.sleep(float(sys.argv[1]))
stopping.check()
"""


def listening(seconds):
    """A process that listens, and then takes so many seconds to stop."""
    process = subprocess.Popen([sys.executable, "-c", LISTEN, str(seconds)], stdout=-1, stderr=-1, text=True)
    assert process.stdout
    assert process.stdout.readline() == "begun\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_sets_a_flag_and_stops_where_it_is_looked_at(number):
    with listening(0.0) as process:
        process.send_signal(number)
        out, err = process.communicate(timeout=30)
    assert out == "asked\n"
    assert err.splitlines()[-1] == "cluster.stopping.Stopped"


def test_a_second_signal_ends_at_once_but_one_that_is_passed_on_does_not():
    """`make` and `uv run` pass on what the terminal sends to all."""
    with listening(60.0) as process:
        process.send_signal(signal.SIGINT)
        assert process.stdout.readline() == "asked\n"
        process.send_signal(signal.SIGTERM)
        time.sleep(stopping.ONE_SIGNAL_S + 0.1)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130


def test_signals_that_the_shell_ignores_stay_ignored(monkeypatch):
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGHUP)}
    try:
        stopping.listen()
        assert [signal.getsignal(number) for number in before] == [signal.SIG_IGN] * 2
        assert signal.getsignal(signal.SIGTERM) is stopping._stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("prog", ["gridsim-evolve", "gridsim-evaluate", "gridsim-compare"])
def test_a_command_is_quiet_if_it_is_stopped_while_its_libraries_load(prog, tmp_path):
    with start(prog, "--help", cwd=tmp_path) as process:
        loaded = Path(f"/proc/{process.pid}/maps")
        wait_until(lambda: process.poll() is not None or "numpy" in loaded.read_text(), 30, 0.005)
        os.kill(process.pid, signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, "", "")
