"""How other projects' learners do on GridSim: python benchmarks/learners.py [--json] [--quick] [--roads [ROAD ...]]

    import_gridsim_ms    `import gridsim` after `import gymnasium`, median of 7 fresh processes
    sb3_vec_env_ratio    car-steps/s under random actions of `SB3VecEnv` with 1,024 cars, over those of
                         Stable-Baselines3's SubprocVecEnv with 8; medians of 5, taken in turn
    ppo_sb3_success      Stable-Baselines3's PPO after 300,000 car-steps on `curved`: share of 64 held-out drives of
                         2,000 m that succeed
    ppo_example_success  examples/ppo.py after 3 minutes on `curved`: share of its last 1,024 training episodes

`--roads` measures instead, among usual traffic on the five roads or those named, in half an hour:

    ppo_sb3_ROAD_60s, _180s    Stable-Baselines3's PPO, two layers of 64 units that see what evolution's see, after so
                               many seconds of learning: share of 512 held-out drives of 2,000 m that succeed
    evolution_ROAD_60s, _180s  the same of `gridsim-evolve`

`--quick` measures the same on a small scale; the figures mean nothing.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from gridsim.envs.sb3 import SB3VecEnv
from gridsim.maps.parts import HELD_OUT_SEED
from gridsim.maps.scenarios import REGISTRY, crowds

ID = "gridsim:GridSim/Curved-v0"  # the module's name lets SubprocVecEnv's processes import it
IMPORT = "import time, gymnasium; a = time.perf_counter(); import gridsim; print(time.perf_counter() - a)"
EXAMPLE = str(Path(__file__).parent.parent / "examples" / "ppo.py")


def output(*arguments: str) -> str:
    """What a Python process prints."""
    return subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.PIPE, text=True).stdout


def steps_per_s(cars: VecEnv, seconds: float) -> float:
    """Car-steps per second under random actions, resets included."""
    rng, steps, begun = np.random.default_rng(0), 0, time.perf_counter()
    while (spent := time.perf_counter() - begun) < seconds:
        cars.step(rng.integers(cars.action_space.n, size=cars.num_envs))
        steps += cars.num_envs
    return steps / spent


def vec_env_ratio(seconds: float, processes: int) -> float:
    """Ratio of their median rates, measured in turn."""
    both: list[VecEnv] = [SB3VecEnv(ID, 1024), make_vec_env(ID, processes, vec_env_cls=SubprocVecEnv)]
    for cars in both:
        cars.reset()
        steps_per_s(cars, seconds)  # builds maps
    turns = [[steps_per_s(cars, seconds) for cars in both] for _ in range(5)]
    for cars in both:
        cars.close()
    ours, theirs = (statistics.median(rates) for rates in zip(*turns, strict=True))
    return ours / theirs


def success(learner: PPO, drives: int, id: str = ID, **options: Any) -> float:
    """Share of held-out drives in which a learner succeeds: of each car the first one."""
    held_out = SB3VecEnv(id, drives, maps=min(drives, 64), map_seed=HELD_OUT_SEED, **options)
    held_out.seed(0)
    observations, succeeded = held_out.reset(), {}
    while len(succeeded) < drives:
        observations, _, dones, infos = held_out.step(learner.predict(observations, deterministic=True)[0])
        for i in np.flatnonzero(dones).tolist():
            succeeded.setdefault(i, infos[i]["is_success"])
    return statistics.mean(succeeded.values())


def ppo_success(car_steps: int, drives: int) -> float:
    """Share of held-out drives in which SB3's PPO succeeds on `curved`."""
    cars = SB3VecEnv(ID, 64, steering=True)
    learner = PPO("MlpPolicy", cars, n_steps=64, batch_size=512, learning_rate=1e-3, seed=0, device="cpu")
    learner.learn(car_steps)
    return success(learner, drives, steering=True)


class Until(BaseCallback):
    """Ends learning after some seconds."""

    def __init__(self, seconds: float):
        super().__init__()
        self.end = time.perf_counter() + seconds

    def _on_step(self) -> bool:
        return time.perf_counter() < self.end


def ppo_on(road: str, cars: int, budgets: tuple[float, ...], drives: int) -> Iterator[float]:
    """Success of SB3's PPO after each number of seconds."""
    id, sees = f"gridsim:GridSim/{road.capitalize()}-v0", {"steering": True, "motion": True, "traffic": cars}
    learner = PPO(
        "MlpPolicy", SB3VecEnv(id, 256, maps=64, **sees), n_steps=128, batch_size=2048, n_epochs=5,
        learning_rate=1e-3, ent_coef=0.003, seed=0, device="cpu",
    )  # fmt: skip
    before = 0.0
    for seconds in budgets:
        learner.learn(1 << 40, Until(seconds - before), reset_num_timesteps=not before)
        before = seconds
        yield success(learner, drives, id, **sees)


def evolution_on(road: str, cars: int, budgets: tuple[float, ...], drives: int) -> Iterator[float]:
    """Success of evolution's champion after each number of seconds."""
    bin = Path(sys.executable).parent
    with tempfile.TemporaryDirectory() as folder:
        begin = ["--scenario", road, "--traffic", str(cars), "--until", "2", "--car-steps", "1e12", "--name", "run"]
        begin += ["--output", folder, "--tracking-uri", f"sqlite:///{folder}/mlflow.db"]
        for seconds in budgets:
            command = [bin / "gridsim-evolve", *begin, "--wall-time", str(seconds)]
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            begin = ["--resume", f"{folder}/run"]
            driven = [bin / "gridsim-evaluate", f"{folder}/run", "--episodes", str(drives), "--json"]
            yield json.loads(subprocess.run(driven, check=True, stdout=subprocess.PIPE).stdout)["success_rate"]


def on_roads(roads: list[str], budgets: tuple[float, ...], drives: int) -> dict[str, float]:
    """The figures of `--roads`."""
    figures = {}
    for road, cars in zip(roads, crowds(",".join(roads), "usual"), strict=True):
        for name, learn in (("ppo_sb3", ppo_on), ("evolution", evolution_on)):
            for seconds, share in zip(budgets, learn(road, cars, budgets, drives), strict=True):
                figures[f"{name}_{road}_{seconds:g}s"] = share
                print(f"{name} {road} {seconds:g} s: {share:.3f}", file=sys.stderr, flush=True)
    return figures


def show(figures: dict[str, float], as_json: bool) -> None:
    """Print figures."""
    lines = (f"{name:<26}{value:>10.3f}" for name, value in figures.items())
    print(json.dumps(figures) if as_json else "\n".join(lines))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one flat JSON object of numbers, nothing else")
    parser.add_argument("--quick", action="store_true", help="on a small scale; the figures mean nothing")
    parser.add_argument("--roads", nargs="*", choices=REGISTRY, metavar="ROAD", help="PPO and evolution on roads")
    options = parser.parse_args()
    quick = options.quick
    if options.roads is not None:
        show(
            on_roads(options.roads or [*REGISTRY], (1.0, 2.0) if quick else (60.0, 180.0), 8 if quick else 512),
            options.json,
        )
        return
    learned = output(EXAMPLE, "--scenario", "curved", "--minutes", "0.05" if quick else "3")
    figures = {
        "import_gridsim_ms": 1e3 * statistics.median(float(output("-c", IMPORT)) for _ in range(7)),
        "sb3_vec_env_ratio": vec_env_ratio(*((0.2, 2) if quick else (2.0, 8))),
        "ppo_sb3_success": ppo_success(4096 if quick else 300_000, 4 if quick else 64),
        "ppo_example_success": float(re.findall(r"([\d.]+)%", learned)[-1]) / 100.0,
    }
    show(figures, options.json)


if __name__ == "__main__":  # SubprocVecEnv's processes import this file
    main()
