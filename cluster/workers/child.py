"""Processes that end when this one does, however it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

# Seconds from SIGTERM to SIGKILL. A run saves and ends in half of that; Ray's head may wait for ever for processes of
# its own that do not end.
GRACE_S = 60
# This shell starts a second one and then becomes the command. The second shell reads from a pipe that only our process
# holds open. When the pipe ends, because we close it or are killed, the second shell ends the command, and then kills
# all that is left in the command's session.
_SHELL = """exec 3<&0; grace_s=$1; shift
(read _ <&3; kill -TERM $$
for _ in $(seq $grace_s); do sleep 1; kill -0 $$ || break; done
kill -KILL -$$) 2>/dev/null &
exec "$@" 3<&- </dev/null"""


class Child:
    """A command in a session of its own, so that Ctrl-C does not reach it. Its output goes to `log`, if given."""

    def __init__(self, command: Sequence[str], environment: dict[str, str] | None = None, log: Path | None = None):
        with open(log or os.devnull, "wb") as output:
            self._process = subprocess.Popen(
                ["/bin/sh", "-c", _SHELL, "sh", str(GRACE_S), *command], env=environment, start_new_session=True,
                stdin=subprocess.PIPE, stdout=output, stderr=output,
            )  # fmt: skip

    def exit_code(self) -> int | None:
        """The command's exit code; None while it runs."""
        return self._process.poll()

    def is_whole(self) -> bool:
        """Whether the command runs and has no zombie among its children (which are seen on Linux alone)."""
        pid = self._process.pid
        with contextlib.suppress(OSError):
            for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
                if Path(f"/proc/{child}/stat").read_text().rpartition(") ")[2].startswith("Z"):
                    return False
        return self.exit_code() is None

    def terminate(self) -> None:
        """End the pipe: the shell sends SIGTERM to the command, and within GRACE_S SIGKILL to its whole session."""
        assert self._process.stdin
        self._process.stdin.close()

    def close(self, patience_s: float | None) -> None:
        """End the command, wait for it (at most `patience_s`; None: any time), and kill what is left of its session.

        That includes the command if it still runs. May be called again.
        """
        self.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
