"""Compiling the kernels before they are needed: once for all processes, and on more than one core.

Numba compiles one function at a time in a process. So separate processes compile what a run needs, and all others then
load it from the cache on disk (`gridsim.jit`).

Run as `python -m cluster.workers.kernels kernels|roads SCENARIO POLICY TRAFFIC COMMAND`, it is such a process: it
prints a line when what a run needs first is compiled, and goes on with what is needed at the run's end. `python -m
cluster.workers.kernels everything` compiles what the learners need by default on all roads, for an image that is to be
started often.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import get_args

import llvmlite.binding
import numpy as np

from cluster.settings import DqnSettings, EvolveSettings, RunSettings
from cluster.workers.worker import CollectTask, Task, Worker
from evolution.episodes.rollout import EPISODE, trajectory
from evolution.networks.policy import Observation, PolicySpec
from evolution.search.base import recipes
from evolution.search.breeding import Kind, Mutation
from gridsim.config import SimConfig
from gridsim.envs.simulator import views
from gridsim.jit import CACHE_FOLDER, CONFIG
from gridsim.maps.map import Map, blank, sample_starts
from gridsim.maps.roads import clearances, freeze
from gridsim.maps.scenarios import REGISTRY, build, default_traffic, is_map_file
from gridsim.traffic.world import spawn


class Warming:
    """Processes that compile what a run needs, if it is not in the cache."""

    def __init__(self, settings: RunSettings):
        self._done = _marker(settings)
        self._what = [settings.scenario, settings.policy, str(settings.traffic), settings.command]
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start the processes. Whether or not all of them could be started, `stop` ends them."""
        for part in () if self._done.exists() else ("kernels", "roads"):
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", "cluster.workers.kernels", part, *self._what],  # -P: not from this folder
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C does not reach it: `stop` ends it
            )
            self.processes.append(process)

    def wait(self) -> None:
        """Wait for what the run needs first. If a process fails, this one compiles its part when it is needed."""
        if all(process.stdout is not None and process.stdout.readline() for process in self.processes):
            with contextlib.suppress(OSError):  # a full disk: the next run starts these processes again
                self._done.touch()

    def reap(self) -> None:
        """Have threads wait for the processes, which would else stay as zombies until the run ends."""
        for process in self.processes:
            threading.Thread(target=process.wait, name="reaper", daemon=True).start()

    def stop(self) -> None:
        """End what still runs."""
        for process in self.processes:
            process.kill()
            process.communicate()


def _marker(settings: RunSettings) -> Path:
    """The file that marks everything that such a run needs as compiled."""
    kind = "cnn" if settings.policy.startswith("cnn") else "mlp"
    road = "file" if is_map_file(settings.scenario) else settings.scenario
    traffic = "traffic" if settings.traffic else "alone"
    # The cache may come from another machine (an image, a shared home): Numba compiles anew for another CPU.
    cpu = CONFIG.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    return CACHE_FOLDER / f"ready-{road}-{kind}-{traffic}-{settings.command}-{cpu}"


def _smallest(policy: str, traffic: int) -> tuple[SimConfig, Map, np.ndarray, np.ndarray, np.ndarray]:
    """The smallest drive: configuration, a map without a road, a genome of zeros, an episode, its traffic."""
    config, genome = SimConfig(), np.zeros(PolicySpec.parse(policy).size, dtype=np.float32)
    road, episodes = blank(), np.zeros(1, dtype=EPISODE)
    episodes["target"] = episodes["steps"] = 1
    worlds = spawn(road.network, episodes["start"], traffic, np.zeros(1, dtype=np.uint64), config)
    return config, road, genome, episodes, worlds


def compile_kernels(policy: str, traffic: int, command: str) -> None:
    """Compile, or load from the cache, what evaluates members, and for the DQN also what collects experience."""
    config, road, genome, episodes, worlds = _smallest(policy, traffic)
    made = recipes(2)
    made["kind"] = Kind.NEW
    task = Task(policy, episodes, worlds, (), config, genome[None], 1, Mutation())
    Worker().answer(task, [road], made, 0, 1)
    if command == DqnSettings.command:
        epsilons, keys = np.zeros(1, dtype=np.float32), np.zeros(1, dtype=np.uint64)
        collecting = CollectTask(policy, episodes, worlds, (), config, genome, epsilons, keys)
        Worker().answer(collecting, [road], made, 0, 1)


def compile_drive(policy: str, traffic: int) -> None:
    """Compile, or load from the cache, what records and draws a drive."""
    config, road, genome, episodes, worlds = _smallest(policy, traffic)
    start = episodes["start"][0]
    _, cars, others = trajectory(PolicySpec.parse(policy), genome, road, start, 1.0, 1, config, worlds[0])
    views(road, cars, others, config)
    clearances(road.road, freeze(cars[:, :2]))


def compile_roads(scenario: str, traffic: int) -> None:
    """Compile, or load from the cache, what builds a scenario's maps."""
    road = build(scenario, 0)
    starts = sample_starts(road, 1, np.random.default_rng(0))
    spawn(road.network, starts, traffic, np.zeros(1, dtype=np.uint64), SimConfig())


def everything_by_default() -> list[RunSettings]:
    """Settings that between them need all that the learners compile by default."""
    return [
        kind(scenario=scenario, traffic=traffic, observation=observation)
        for scenario in REGISTRY
        for traffic in sorted({0, default_traffic(scenario)})
        for kind in (EvolveSettings, DqnSettings)
        for observation in get_args(Observation)
    ]


def main(part: str, scenario: str = "", policy: str = "", cars: str = "0", command: str = "") -> None:
    """Compile one part, in a process of its own."""
    traffic = int(cars)
    if part == "everything":
        for settings in everything_by_default():
            compile_kernels(settings.policy, settings.traffic, settings.command)
            compile_roads(settings.scenario, settings.traffic)
            compile_drive(settings.policy, settings.traffic)
            _marker(settings).touch()
            print(_marker(settings).name, flush=True)
    elif part == "kernels":
        compile_kernels(policy, traffic, command)
        print("ready", flush=True)
    else:
        compile_roads(scenario, traffic)
        print("ready", flush=True)
        os.nice(10)
        compile_drive(policy, traffic)


if __name__ == "__main__":
    main(*sys.argv[1:])
