"""Processes that end when this one does, however it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

# Seconds from SIGTERM to SIGKILL. A run saves and ends in half of that. Ray's head never ends if it waits, in vain, for
# its own processes.
GRACE_S = 60
# This shell becomes the command. The one that it starts ends that, and all in its session, when a pipe ends which only
# we hold open: if we close it, and also if we are killed.
_SHELL = """exec 3<&0; grace_s=$1; shift
(read _ <&3; kill -TERM $$
for _ in $(seq $grace_s); do sleep 1; kill -0 $$ || break; done
kill -KILL -$$) 2>/dev/null &
exec "$@" 3<&- </dev/null"""


class Child:
    """A command in a session of its own, so that Ctrl-C does not reach it. What it prints goes to a file, `log`."""

    def __init__(self, command: Sequence[str], environment: dict[str, str] | None = None, log: Path | None = None):
        with open(log or os.devnull, "wb") as output:
            self._process = subprocess.Popen(
                ["/bin/sh", "-c", _SHELL, "sh", str(GRACE_S), *command], env=environment, start_new_session=True,
                stdin=subprocess.PIPE, stdout=output, stderr=output,
            )  # fmt: skip

    def exit_code(self) -> int | None:
        """None while it runs."""
        return self._process.poll()

    def is_whole(self) -> bool:
        """Whether it runs, and so do the processes that it has started; of these only Linux tells at once."""
        pid = self._process.pid
        with contextlib.suppress(OSError):
            for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
                if Path(f"/proc/{child}/stat").read_text().rpartition(") ")[2].startswith("Z"):
                    return False
        return self.exit_code() is None

    def terminate(self) -> None:
        """Send it SIGTERM."""
        assert self._process.stdin
        self._process.stdin.close()

    def close(self, patience_s: float | None) -> None:
        """End it; after `patience_s`, None is any time, kill what is left in its session. May be called again."""
        self.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
