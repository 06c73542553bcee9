"""A run's figures among those of its Ray cluster, which Prometheus reads from each node (`ray.util.metrics`)."""

from __future__ import annotations

import time
from typing import Any

GAUGE_S = 1.0  # between two values of what goes up and down


class RunMetrics:
    """What a pool tells its cluster, under names that begin with `gridsim_` and tagged with the run's name.

    Args:
        metrics: the module `ray.util.metrics`.
        run: the run's name.
    """

    def __init__(self, metrics: Any, run: str):
        def make(kind: Any, name: str, description: str) -> Any:
            metric = kind(f"gridsim_{name}", description=description, tag_keys=("run",))
            return metric.set_default_tags({"run": run})

        self._queue = make(metrics.Gauge, "queue", "Chunks that no worker holds yet.")
        self._workers = make(metrics.Gauge, "workers", "Workers that are up.")
        self._counters = [
            make(metrics.Counter, "car_steps", "Control steps that were driven."),
            make(metrics.Counter, "retries", "Chunks that were sent again because their worker died."),
            make(metrics.Counter, "lost_chunks", "Members or episodes that killed every worker that tried them."),
        ]
        self._told = 0.0

    def gauge(self, queue: int, workers: int) -> None:
        """Tell what is now, once a second at most."""
        now = time.monotonic()
        if now - self._told >= GAUGE_S:
            self._told = now
            self._queue.set(queue)
            self._workers.set(workers)

    def count(self, car_steps: int, retries: int, lost: int) -> None:
        """Tell what has come since the last time, now that nothing waits."""
        self._queue.set(0)
        for counter, value in zip(self._counters, (car_steps, retries, lost), strict=True):
            if value:
                counter.inc(value)
