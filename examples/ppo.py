"""PPO on GridSim in one file, in the manner of CleanRL: from nothing to a car that drives, in three minutes.

    python examples/ppo.py --scenario curved --minutes 3

Proximal policy optimisation (Schulman et al. 2017) with generalised advantage estimation (Schulman et al. 2016), on all
cars of one vector environment. It needs PyTorch, which GridSim brings along.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from torch import nn

import gridsim  # noqa: F401, registers the environments

STEPS = 32  # of each car, in a batch
EPOCHS, MINIBATCHES = 4, 4
LEARNING_RATE, DISCOUNT, LAMBDA = 1e-3, 0.99, 0.95
CLIP, ENTROPY, VALUE = 0.2, 0.003, 0.5


def network(inputs: int, outputs: int, gain: float) -> nn.Sequential:
    """Two hidden layers; with a small gain the last one's outputs are about equal at the beginning."""

    def layer(before: int, after: int, gain: float) -> nn.Linear:
        made = nn.Linear(before, after)
        nn.init.orthogonal_(made.weight, gain)
        nn.init.zeros_(made.bias)
        return made

    return nn.Sequential(
        layer(inputs, 64, 2**0.5), nn.Tanh(), layer(64, 64, 2**0.5), nn.Tanh(), layer(64, outputs, gain)
    )


def main() -> None:
    """Learn, and print how it goes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="curved", help="curved, seamless, highway, roundabout or city")
    parser.add_argument("--traffic", type=int, default=0, help="other cars")
    parser.add_argument("--cars", type=int, default=1024, help="that drive at once")
    parser.add_argument("--minutes", type=float, default=3.0, help="how long to learn")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cars = options.cars
    torch.manual_seed(options.seed)
    torch.set_num_threads(1)  # for networks as small as these, threads cost more than they gain

    env: Any = gymnasium.make_vec(
        f"GridSim/{options.scenario.capitalize()}-v0", num_envs=cars, steering=True, traffic=options.traffic,
        autoreset_mode=AutoresetMode.SAME_STEP,
    )  # fmt: skip
    inputs, actions = env.single_observation_space.shape[0], env.single_action_space.n
    actor, critic = network(inputs, actions, 0.01), network(inputs, 1, 1.0)
    parameters = [*actor.parameters(), *critic.parameters()]
    optimiser = torch.optim.Adam(parameters, LEARNING_RATE, eps=1e-5)

    observation, _ = env.reset(seed=options.seed)
    started, car_steps, succeeded = time.perf_counter(), 0, []
    while (share := (time.perf_counter() - started) / (60 * options.minutes)) < 1.0:
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1.0 - share)

        # Collect a batch.
        o_t = torch.empty(STEPS, cars, inputs)
        a_t = torch.empty(STEPS, cars, dtype=torch.long)
        logp_t, r_t, v_t, go_on_t, v_after_t = (torch.zeros(STEPS, cars) for _ in range(5))
        with torch.no_grad():
            for t in range(STEPS):
                o_t[t] = torch.as_tensor(observation)
                policy = torch.distributions.Categorical(logits=actor(o_t[t]))
                a_t[t] = policy.sample()
                logp_t[t], v_t[t] = policy.log_prob(a_t[t]), critic(o_t[t]).squeeze(-1)
                observation, reward, terminated, truncated, info = env.step(a_t[t].numpy())
                r_t[t], go_on_t[t] = torch.as_tensor(reward), torch.as_tensor(~(terminated | truncated)).float()
                if truncated.any():  # the episode would have gone on: what follows its last observation still counts
                    last = torch.as_tensor(np.stack(info["final_obs"][truncated]))
                    v_after_t[t, torch.as_tensor(truncated)] = critic(last).squeeze(-1)
                over = terminated | truncated
                if over.any():
                    succeeded += info["final_info"]["is_success"][over].tolist()
            advantage, ahead = torch.empty(STEPS, cars), torch.zeros(cars)
            v_tp1 = critic(torch.as_tensor(observation)).squeeze(-1)
            for t in reversed(range(STEPS)):
                delta = r_t[t] + DISCOUNT * (go_on_t[t] * v_tp1 + v_after_t[t]) - v_t[t]
                advantage[t] = ahead = delta + DISCOUNT * LAMBDA * go_on_t[t] * ahead
                v_tp1 = v_t[t]
        car_steps += STEPS * cars

        # Learn from it.
        o, a, logp, adv = o_t.flatten(0, 1), a_t.flatten(), logp_t.flatten(), advantage.flatten()
        returns = adv + v_t.flatten()
        for _ in range(EPOCHS):
            for chosen in torch.randperm(STEPS * cars).split(STEPS * cars // MINIBATCHES):
                policy = torch.distributions.Categorical(logits=actor(o[chosen]))
                ratio = (policy.log_prob(a[chosen]) - logp[chosen]).exp()
                gain = (adv[chosen] - adv[chosen].mean()) / (adv[chosen].std() + 1e-8)
                policy_loss = -torch.min(ratio * gain, ratio.clamp(1 - CLIP, 1 + CLIP) * gain).mean()
                value_loss = (critic(o[chosen]).squeeze(-1) - returns[chosen]).square().mean()
                loss = policy_loss + VALUE * value_loss - ENTROPY * policy.entropy().mean()
                optimiser.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimiser.step()
        latest = succeeded[-cars:]
        print(
            f"{car_steps / 1e6:6.2f} million car-steps  {car_steps / (time.perf_counter() - started):9,.0f} a second  "
            f"reward {r_t.mean():6.3f}  success of the last {len(latest)} episodes {np.mean(latest or [0]):6.1%}",
            flush=True,
        )
    env.close()


if __name__ == "__main__":
    main()
