"""Which commit a run was made from."""

import functools
import os
import subprocess
from pathlib import Path

DIRTY = "-dirty"


@functools.cache
def git_commit() -> str:
    """The commit that this code was checked out from, followed by DIRTY if a tracked file was changed since.

    `unknown` outside git: an installed copy, no git, no commit.
    """
    here = Path(__file__).resolve()
    # A hook's GIT_DIR would lead to another repository.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=5.0, check=True)
        return done.stdout.strip()

    try:
        # If installed into a .venv inside another repository, this file is not tracked there.
        git("ls-files", "--error-unmatch", here.name)
        return git("--no-optional-locks", "describe", "--always", "--abbrev=40", "--exclude=*", f"--dirty={DIRTY}")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
