"""How a pool of workers is opened."""

from __future__ import annotations

from cluster.workers.pool import BuildMap, WorkerPool
from cluster.workers.threads import ThreadPool


def open_pool(workers: int, address: str | None, patience_s: float, build_map: BuildMap) -> WorkerPool:
    """Open a pool, and return once it can work. Call this before any thread is started: it sets environment variables.

    Args:
        workers: how many Ray workers. With 0 and without an address: threads of this process, on all its cores.
        address: an existing Ray cluster (`host:port` or `auto`), on which 0 workers mean one for each free CPU; None: a
            Ray of our own, which is started on this machine. If this process has initialised Ray already, that is used;
            then host:port is refused.
        patience_s: how long to go on without any Ray worker, and to wait for a silent one; 0: 300 s, but 60 s for a
            silent one in a Ray of our own.

    Raises: PoolError, in one line.
    """
    if workers == 0 and address is None:
        return ThreadPool(build_map)
    from cluster.workers.ray_pool import RayPool  # here, because it imports Ray

    pool = RayPool(workers, build_map, address, patience_s)
    try:
        pool.open()
    except BaseException:
        pool.close()
        raise
    return pool
