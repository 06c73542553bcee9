"""Steps per second of another driving environment under random actions, resets included.

    python benchmarks/peers.py NAME

`throughput.py --peers [PYTHON]` runs this file once for each, on the core it is pinned to, with that Python: this file
needs nothing of this project, so peers may live in an environment of their own. It prints one number; for a peer that
is not installed it exits with 3, and a line on stderr says what to do.

highway-env decides 15 times a second here, once per simulated step (by default once a second, which would be slower);
all else is each project's default: 50 other cars on highway-env, one in ten places of traffic in MetaDrive.
"""

from __future__ import annotations

import importlib.util
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

NOT_INSTALLED = 3  # exit code
SECONDS = 3.0  # for which steps are taken


def _highway(observation: str) -> Callable[[], Any]:
    def make() -> Any:
        import gymnasium
        import highway_env  # noqa: F401, registers its ids

        config = {"observation": {"type": observation}, "policy_frequency": 15, "simulation_frequency": 15}
        return gymnasium.make("highway-v0", config=config)

    return make


def _metadrive() -> Any:
    from metadrive import MetaDriveEnv

    return MetaDriveEnv({"log_level": 50, "num_scenarios": 8})


def _car_racing() -> Any:
    import gymnasium

    return gymnasium.make("CarRacing-v3", continuous=False)


class Peer(NamedTuple):
    """Another environment, and which of our figures to compare it with."""

    module: str
    pip: str  # what installs it
    ours: str
    make: Callable[[], Any]


PEERS = {
    "highway_env_grid": Peer("highway_env", "highway-env", "vector_env_grid_traffic", _highway("OccupancyGrid")),
    "highway_env_lidar": Peer("highway_env", "highway-env", "vector_env_rays_traffic", _highway("LidarObservation")),
    "metadrive_lidar": Peer("metadrive", "metadrive-simulator", "vector_env_rays_traffic", _metadrive),
    "car_racing": Peer("Box2D", '"gymnasium[box2d]"', "vector_env_grid", _car_racing),
}


def steps_per_s(env: Any) -> float:
    """Steps per second over SECONDS, resets included."""
    env.action_space.seed(0)
    env.reset(seed=0)
    env.step(env.action_space.sample())
    steps, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < SECONDS:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        steps += 1
        if terminated or truncated:
            env.reset()
    env.close()
    return steps / spent


def main() -> int:
    """Run one."""
    if len(sys.argv) != 2 or sys.argv[1] not in PEERS:
        print(f"usage: python benchmarks/peers.py {'|'.join(PEERS)}", file=sys.stderr)
        return 2
    peer = PEERS[sys.argv[1]]
    if importlib.util.find_spec(peer.module) is None:
        print(f"not installed: pip install {peer.pip}", file=sys.stderr)
        return NOT_INSTALLED
    print(steps_per_s(peer.make()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
