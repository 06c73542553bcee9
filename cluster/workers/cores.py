"""The CPU cores that this process may use: those of its affinity, within its control group's quota.

`docker run --cpus`, a limit of Kubernetes and CPUQuota of systemd set such a quota. joblib reads it too, but only that
of the topmost group, and its import takes 0.3 s.
"""

import contextlib
import math
import os
from pathlib import Path


def cores(root: Path = Path("/")) -> int:
    """CPU cores that this process may use, rounded up, so at least 1. `root` is where /proc and /sys are."""
    least = float(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
    with contextlib.suppress(OSError):  # no Linux
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers and "cpu" not in controllers.split(","):
                continue
            folder, files = root / "sys/fs/cgroup", ["cpu.max"]
            if controllers:  # version 1 of control groups
                folder, files = folder / "cpu", ["cpu.cfs_quota_us", "cpu.cfs_period_us"]
            # Quotas of the groups above count, too. In a container the path may be the host's, whose groups do not
            # exist in the container.
            for name in (".", *path.split("/")):
                folder /= name
                with contextlib.suppress(OSError, ValueError):  # no such group; "max", no quota
                    quota, period = " ".join((folder / file).read_text() for file in files).split()
                    least = min(least, int(quota) / int(period) if int(quota) > 0 else least)  # -1: no quota
    return math.ceil(least)
