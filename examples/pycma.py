"""CMA-ES, of the library `cma`, learns to drive: python examples/pycma.py [--scenario curved] [--minutes 3]

Each generation drives new episodes, the same for all of its members. `pip install cma` first.
"""

import argparse
import time

import cma
import numpy as np

import gridsim
from gridsim.config import EpisodeConfig, SimConfig

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--scenario", default="curved", help="road to learn on (curved)")
parser.add_argument("--minutes", type=float, default=3.0, help="of learning, at most (3)")
parser.add_argument("--output", default="champion.npz", help="file to keep the driver in (champion.npz)")
options = parser.parse_args()

ends, success = time.monotonic() + 60.0 * options.minutes, 0.0
short = SimConfig(episode=EpisodeConfig(target=400.0, time_limit=60.0))  # m and s; held-out drives are of 2,000 m
with gridsim.Evaluator(options.scenario, policy="mlp:8", traffic=0, sim=short, episodes=16) as evaluator:
    # CMA_diagonal: with hundreds of genes, their covariances would take too many generations to learn.
    chosen = {"popsize": 64, "seed": 1, "CMA_diagonal": True, "verbose": -9}
    search, generation = cma.CMAEvolutionStrategy(np.zeros(evaluator.genes), 0.5, chosen), 0
    while success < 0.99 and time.monotonic() < ends:
        members = search.ask()
        scores = evaluator.fitness(np.array(members, dtype=np.float32), seed=generation)
        search.tell(members, list(-scores))  # it minimises
        if generation % 10 == 0:
            driver = evaluator.champion(search.mean.astype(np.float32), SimConfig())
            success = gridsim.evaluate(driver)["success_rate"]
            print(
                f"generation {generation}: fitness {scores.mean():.3f}, success on held-out roads {success:.0%}",
                flush=True,
            )
        generation += 1

driver.save(options.output)
print(f"watch it: gridsim-watch {options.output}")
