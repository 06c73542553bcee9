"""A run's maps, each built once, most of them ahead of their use."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from gridsim.config import SimConfig
from gridsim.maps.map import Map
from gridsim.maps.parts import seed_of_map
from gridsim.maps.scenarios import build


class Maps:
    """The maps of one scenario, by their seeds; a thread builds them ahead."""

    def __init__(self, scenario: str, config: SimConfig):
        self._scenario, self.config = scenario, config
        self._built: dict[int, Future[Map]] = {}
        self._seeds: dict[int, int] = {}  # of each seed, the smallest seed with the same map
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="maps")

    def ahead(self, seeds: Sequence[int]) -> None:
        """Begin to build maps that will be needed, in this order, after those that were named before."""
        for seed in map(self._seed, seeds):
            if seed not in self._built:
                self._built[seed] = self._thread.submit(build, self._scenario, seed, self.config)

    def get(self, seed: int) -> Map:
        """The map of a seed. If the thread has not begun to build it, the caller builds it."""
        seed = self._seed(seed)
        future = self._built.get(seed)
        if future is None or future.cancel():
            future = self._built[seed] = Future()
            future.set_result(build(self._scenario, seed, self.config))
        return future.result()

    def names(self, seeds: Sequence[int]) -> tuple[tuple[str, int], ...]:
        """The names by which pools know the maps of these seeds: scenario and seed."""
        return tuple((self._scenario, self._seed(seed)) for seed in seeds)

    def _seed(self, seed: int) -> int:
        if seed not in self._seeds:
            self._seeds[seed] = seed_of_map(self._scenario, seed)
        return self._seeds[seed]

    def build(self, scenario: str, seed: int) -> Map:
        """`get`, as pools call it: with the scenario, which is the run's, and a seed."""
        return self.get(seed)

    def close(self) -> None:
        """Cancel what has not begun."""
        self._thread.shutdown(wait=False, cancel_futures=True)
