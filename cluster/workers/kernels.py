"""Compiling the kernels that a run needs, before it needs them: once for all processes, and on more than one core.

Numba compiles one function at a time in a process. So separate processes compile what is missing in the cache on disk
(`gridsim.jit`), from which all other processes then load it. Their command is `python -m cluster.workers.kernels PART
SCENARIO SIM POLICY TRAFFIC COMMAND [OWN]`, where PART is one of `PARTS`, and TRAFFIC a number of cars. `python -m
cluster.workers.kernels everything` compiles what the learners need by default on all roads, for a container image that
is to be started often.
"""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import get_args

import llvmlite.binding
import numpy as np

from cluster import stopping
from cluster.settings import DqnSettings, EvolveSettings, RunSettings
from cluster.text import file_name
from cluster.workers.child import Child
from cluster.workers.pool import LOOK_S
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.episodes.rollout import EPISODE, trajectory
from evolution.networks.policy import CONTINUOUS, Observation, PolicySpec
from evolution.search.base import recipes
from evolution.search.breeding import Kind, Mutation
from gridsim.config import SimConfig
from gridsim.jit import CACHE_FOLDER, CONFIG, freeze
from gridsim.maps.map import blank, sample_starts
from gridsim.maps.parts import is_map_file, roads_of
from gridsim.maps.roads import clearances
from gridsim.maps.scenarios import REGISTRY, build, label, traffic_on
from gridsim.sensing.imperfections import imperfections_of
from gridsim.simulator import views
from gridsim.state import CAR_FIELDS
from gridsim.traffic.world import spawn

OWN = "fitness"  # says in a marker's name and on a command line that the run has a fitness of the user's own
PARTS = ("kernels", "roads")  # compiled side by side: what drives, and what builds maps and looks around on them


def _marker(settings: RunSettings) -> Path:
    """The file whose existence says that all kernels that such a run needs are compiled."""
    kind = "cnn" if settings.policy.startswith("cnn") else "mlp"
    road = "file" if is_map_file(settings.scenario) else file_name(label(settings.scenario))
    traffic = "traffic" if settings.traffic else "alone"
    sim = settings.simulator()
    chosen = {sim.vehicle.model: sim.vehicle.model != "kinematic", OWN: has_own(settings)}
    chosen |= {"imperfect": any(imperfections_of(sim, sim)), "continuous": settings.policy.endswith(CONTINUOUS)}
    special = "".join(f"{name}-" for name, there in chosen.items() if there)
    # The cache may come from another machine (an image, a shared home): Numba compiles anew for another CPU.
    cpu = CONFIG.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    return CACHE_FOLDER / f"ready-{road}-{kind}-{traffic}-{special}{settings.command}-{cpu}"


def has_own(settings: RunSettings) -> bool:
    """Whether a run has a fitness of the user's own; episodes' results then have figures of comfort."""
    return isinstance(settings, EvolveSettings) and bool(settings.fitness)


def is_compiled(settings: RunSettings) -> bool:
    """Whether the cache has all kernels that a run needs; else `compile_ahead` takes some 20 s."""
    return _marker(settings).exists()


def compile_ahead(settings: RunSettings) -> None:
    """Compile the kernels that a run needs, in other processes. If that fails, they are compiled on first use."""
    what = [settings.scenario, settings.sim, settings.policy, str(max(settings.crowds)), settings.command]
    what += [OWN] if has_own(settings) else []
    compilers = list[Child]()
    try:
        for part in PARTS:  # -P: no module of the working folder is imported
            compilers.append(Child([sys.executable, "-P", "-m", "cluster.workers.kernels", part, *what]))
        while None in (codes := [compiler.exit_code() for compiler in compilers]):
            stopping.check()
            time.sleep(LOOK_S)
        if not any(codes):
            with contextlib.suppress(OSError):  # a full disk: the next run starts these processes again
                _marker(settings).touch()
    finally:
        for compiler in compilers:
            compiler.close(0.0)


def compile_part(part: str, scenario: str, sim: str, policy: str, traffic: int, command: str, own: str = "") -> None:
    """Compile one of PARTS in this process, or load it from the cache, by using it.

    The drives have one step, on a map without a road; `roads` also builds a map of each road of the scenario.
    """
    config, spec, road = SimConfig.load(sim), PolicySpec.parse(policy), blank()
    genome, keys = np.zeros(spec.size, dtype=np.float32), np.zeros(1, dtype=np.uint64)
    episodes = np.zeros(1, dtype=EPISODE)
    episodes["target"] = episodes["steps"] = 1
    worlds = spawn(road.network, episodes["start"], traffic, keys, config)
    if part == "kernels":
        shared, made = (policy, episodes, worlds, (), config), recipes(2)
        made["kind"] = Kind.NEW
        Worker().answer(Task(*shared, genome[None], 1, Mutation(), bool(own)), [road], made, slice(0, 1))
        if command == DqnSettings.command:
            Worker().answer(
                CollectTask(*shared, genome, np.zeros(1, dtype=np.float32), keys), [road], made, slice(0, 1)
            )
        # It needs most of the kernels that are compiled by now; the process of the other part would compile them again.
        trajectory(spec, genome, road, episodes["start"][0], 1.0, 1, config, worlds[0])
        return
    for seed in range(len(roads_of(scenario))):
        built = build(scenario, seed, config)
        spawn(built.network, sample_starts(built, 1, np.random.default_rng(0)), traffic, keys, config)
    cars = np.zeros((1, CAR_FIELDS), dtype=np.float32)
    views(road, cars, worlds, config, spec.features)
    clearances(road.road, freeze(cars[:, :2]))


def everything_by_default() -> list[RunSettings]:
    """Settings of runs that together need all kernels that the learners need by default."""
    return [
        kind(scenario=scenario, traffic=traffic, observation=observation)
        for scenario in REGISTRY
        for traffic in sorted({0, traffic_on(scenario)})
        for kind in (EvolveSettings, DqnSettings)
        for observation in get_args(Observation)
    ]


def main(part: str, *what: str) -> None:
    """Compile one part for one run, or all parts for all runs by default settings, in this process."""
    if part != "everything":
        scenario, sim, policy, traffic, *rest = what
        compile_part(part, scenario, sim, policy, int(traffic), *rest)
        return
    for settings in everything_by_default():
        for each in PARTS:
            cars = max(settings.crowds)
            compile_part(each, settings.scenario, settings.sim, settings.policy, cars, settings.command)
        _marker(settings).touch()
        print(_marker(settings).name, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
