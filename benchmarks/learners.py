"""How other projects' learners do on GridSim: python benchmarks/learners.py [--json] [--quick]

    import_gridsim_ms    `import gridsim` after `import gymnasium`, median of 7 fresh processes
    sb3_vec_env_ratio    car-steps/s under random actions of `SB3VecEnv` with 1,024 cars, over those of
                         Stable-Baselines3's SubprocVecEnv with 8; medians of 5, taken in turn
    ppo_sb3_success      Stable-Baselines3's PPO after 300,000 car-steps on `curved`: share of 64 held-out drives of
                         2,000 m that succeed
    ppo_example_success  examples/ppo.py after 3 minutes on `curved`: share of its last 1,024 training episodes

`--quick` measures the same on a small scale; the figures mean nothing.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from gridsim.envs.sb3 import SB3VecEnv
from gridsim.maps.parts import HELD_OUT_SEED

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


def vec_env_ratio(seconds: float) -> float:
    """Ratio of their median rates, measured in turn."""
    both: list[VecEnv] = [SB3VecEnv(ID, 1024), make_vec_env(ID, 8, vec_env_cls=SubprocVecEnv)]
    for cars in both:
        cars.reset()
        steps_per_s(cars, seconds)  # builds maps
    turns = [[steps_per_s(cars, seconds) for cars in both] for _ in range(5)]
    for cars in both:
        cars.close()
    ours, theirs = (statistics.median(rates) for rates in zip(*turns, strict=True))
    return ours / theirs


def ppo_success(car_steps: int, drives: int) -> float:
    """Share of held-out drives, on as many maps, in which SB3's PPO succeeds."""
    cars = SB3VecEnv(ID, 64, steering=True)
    learner = PPO("MlpPolicy", cars, n_steps=64, batch_size=512, learning_rate=1e-3, seed=0, device="cpu")
    learner.learn(car_steps)
    held_out = SB3VecEnv(ID, drives, steering=True, maps=drives, map_seed=HELD_OUT_SEED)
    held_out.seed(0)
    observations, succeeded = held_out.reset(), {}
    while len(succeeded) < drives:  # each car's first drive
        observations, _, dones, infos = held_out.step(learner.predict(observations, deterministic=True)[0])
        for i in np.flatnonzero(dones).tolist():
            succeeded.setdefault(i, infos[i]["is_success"])
    return statistics.mean(succeeded.values())


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one flat JSON object of numbers, nothing else")
    parser.add_argument("--quick", action="store_true", help="on a small scale; the figures mean nothing")
    options = parser.parse_args()
    quick = options.quick
    learned = output(EXAMPLE, "--scenario", "curved", "--minutes", "0.05" if quick else "3")
    figures = {
        "import_gridsim_ms": 1e3 * statistics.median(float(output("-c", IMPORT)) for _ in range(7)),
        "sb3_vec_env_ratio": vec_env_ratio(0.2 if quick else 2.0),
        "ppo_sb3_success": ppo_success(4096 if quick else 300_000, 4 if quick else 64),
        "ppo_example_success": float(re.findall(r"([\d.]+)%", learned)[-1]) / 100.0,
    }
    lines = (f"{name:<20}{value:>10.2f}" for name, value in figures.items())
    print(json.dumps(figures) if options.json else "\n".join(lines))


if __name__ == "__main__":  # SubprocVecEnv's processes import this file
    main()
