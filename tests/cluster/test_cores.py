"""Workers are counted from the cores that this process may use: affinity, and the quotas of containers."""

import pytest

from cluster.workers import cores as module
from cluster.workers.cores import cores

V1 = "9:name=systemd:/\n4:cpu,cpuacct:/kubepods/pod1\n3:cpuset:/\n"


@pytest.mark.parametrize(
    ("groups", "files", "count"),
    [
        ("0::/\n", {"cpu.max": "max 100000"}, 8),
        ("0::/\n", {"cpu.max": "250000 100000"}, 3),
        ("0::/\n", {"cpu.max": "50000 100000"}, 1),
        ("0::/\n", {"cpu.max": "6400000 100000"}, 8),
        # CPUQuota of a service, and of the slice it is in, as the host sees them.
        ("0::/a.slice/b.service\n", {"a.slice/cpu.max": "200000 100000", "a.slice/b.service/cpu.max": "max 1"}, 2),
        # The path on the host, which is not in the container.
        ("0::/docker/abc\n", {"cpu.max": "200000 100000"}, 2),
        (V1, {"cpu/kubepods/pod1/cpu.cfs_quota_us": "100000", "cpu/kubepods/pod1/cpu.cfs_period_us": "100000"}, 1),
        (V1, {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 8),
        ("0::/\n", {"cpu.max": "nonsense"}, 8),
        (None, {}, 8),
    ],
)  # fmt: skip
def test_the_quota_of_a_container_counts(groups, files, count, tmp_path, monkeypatch):
    monkeypatch.setattr(module.os, "sched_getaffinity", lambda pid: set(range(8)), raising=False)
    if groups is not None:
        (tmp_path / "proc/self").mkdir(parents=True)
        (tmp_path / "proc/self/cgroup").write_text(groups)
    for name, content in files.items():
        file = tmp_path / "sys/fs/cgroup" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(f"{content}\n")
    assert cores(tmp_path) == count
