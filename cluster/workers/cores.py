"""The CPU cores that this process may use: those of its affinity, within its control group's quota.

`docker run --cpus`, a limit of Kubernetes and CPUQuota of systemd set such a quota. joblib reads it too, but only that
of the topmost group, and its import takes 0.3 s.
"""

import contextlib
import math
import os
from pathlib import Path


def cores(root: Path = Path("/")) -> int:
    """CPU cores that this process may use, at least 1. `root` is where /proc and /sys are."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return math.ceil(min([usable, *_quotas(root)]))


def _quotas(root: Path) -> list[float]:
    """CPU quotas, in cores, of this process's control groups and of all above them; none outside Linux."""
    found = []
    groups = root / "sys/fs/cgroup"
    with contextlib.suppress(OSError):
        for line in (root / "proc/self/cgroup").read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "":  # version 2
                top, files = groups, ["cpu.max"]
            elif "cpu" in controllers.split(","):  # version 1
                top, files = groups / "cpu", ["cpu.cfs_quota_us", "cpu.cfs_period_us"]
            else:
                continue
            # In a container, the path may be that on the host, of which only the top is seen.
            for name in (".", *path.split("/")):
                top /= name
                with contextlib.suppress(OSError, ValueError):  # no such group; "max", no quota
                    quota, period = " ".join((top / file).read_text() for file in files).split()
                    if int(quota) > 0:  # version 1 has -1 for no quota
                        found.append(int(quota) / int(period))
    return found
