"""Which commit a run was made from."""

import subprocess
from pathlib import Path


def git_commit() -> str:
    """The commit that this code was checked out from, with `-dirty` behind it if a tracked file was changed since.

    `unknown` outside git: an installed copy, no git, no commit.
    """
    here = Path(__file__).resolve()

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(here.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=True).stdout.strip()

    try:
        # If installed into a .venv inside another repository, this file is not tracked there.
        git("ls-files", "--error-unmatch", here.name)
        return git("--no-optional-locks", "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty")
    except (OSError, subprocess.SubprocessError):
        return "unknown"
