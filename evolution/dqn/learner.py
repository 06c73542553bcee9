"""The DQN learner: a Q network, its target network, and their updates. No other file computes gradients.

The Q network is a policy whose 8 outputs are the actions' values. So it can drive wherever a policy can.

An update (Mnih et al. 2015, "Human-level control through deep reinforcement learning") takes a batch from the replay
and moves Q(s_t, a_t) towards

    y = r_t + discount Q_target(s_{t+1}, argmax_a Q(s_{t+1}, a))

which is Double DQN (van Hasselt et al. 2016, "Deep Reinforcement Learning with Double Q-learning"). The discount is 0
if step t terminated the episode. The loss is Huber's, the optimiser Adam (Kingma and Ba 2015).

The result depends only on the seed, the parameters and the replay's contents, bit for bit on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from torch.optim.adam import adam

from evolution.dqn.replay import Batch, Replay
from evolution.networks.export import layers_of
from evolution.networks.policy import KERNEL_1, KERNEL_2, STRIDE_1, STRIDE_2, CnnSpec, PolicySpec, squash
from gridsim.errors import GridSimError
from gridsim.jit import njit
from gridsim.sensing.grid import CELLS

T = TypeVar("T", np.ndarray, float)
RANDOM_SHARE = 0.02  # share of the car-steps of --anneal in which exploration falls from 1 to an episode's final share
# Final exploration goes from epsilon, in a batch's first episode, to epsilon ** (1 + SPREAD), in its last (alpha of
# Horgan et al. 2018).
SPREAD = 7.0
_WEIGHTS, _SAMPLES = 0, 1  # purposes of random numbers
# PyTorch's Adam as a function, because the overhead of its class exceeds the time of the step.
_adam = partial(adam, fused=True, amsgrad=False, beta1=0.9, beta2=0.999, weight_decay=0.0, maximize=False)


@dataclass(frozen=True)
class DqnConfig:
    """The learner's parameters."""

    batch: int = 256  # transitions of an update
    learning_rate: float = 1e-3  # Adam's, at the beginning
    final_learning_rate: float = 0.05  # Adam's after `learning_rate_updates`, as a share of `learning_rate`
    learning_rate_updates: int = 50_000  # updates over which the learning rate falls linearly
    adam_epsilon: float = 1e-5  # Adam's; greater than its authors' 1e-8 since squared gradients are small (Rainbow)
    target_period: int = 500  # updates between copies of the network to the target
    average: int = 2000  # time constant, in updates, of the exponential average of weights (Polyak and Juditsky 1992)
    # Absolute error above which the loss is linear. It is as large as returns: with 1 (Mnih et al. 2015), Q would
    # estimate the median return, in which rare crashes have too little weight.
    huber_delta: float = 30.0
    gradient_clip: float = 10.0  # greatest norm of a gradient (Wang et al. 2016, "Dueling Network Architectures")

    def learning_rate_at(self, update: int) -> float:
        """Adam's learning rate in an update, counted from 0."""
        share = min(update / self.learning_rate_updates, 1.0)
        return self.learning_rate * (1.0 + (self.final_learning_rate - 1.0) * share)


def exploration(epsilon: float, progress: float, episodes: int) -> np.ndarray:
    """Share of random actions in each episode of a batch: float32 [episodes].

    As the run progresses, each share falls from 1 to a final one: `epsilon` in the first episode of a batch, and less
    in later ones. Args: `progress`, car-steps so far, divided by --anneal; `episodes`, their number.
    """
    usual = epsilon ** (1.0 + SPREAD * np.arange(episodes) / max(episodes - 1, 1))
    random = max(1.0 - min(progress, 1.0) / RANDOM_SHARE, 0.0)
    return (usual + (1.0 - usual) * random).astype(np.float32)


def finite(numbers: T, update: int) -> T:
    """Return weights, values or a loss unchanged. Raises: FloatingPointError if any of them is not finite."""
    if not np.isfinite(numbers).all():
        raise FloatingPointError(f"the Q network diverged at update {update}: try a lower learning rate")
    return numbers


def device_of(name: str) -> torch.device:
    """The device `auto`, `cpu` or `cuda`; `auto` is cuda where there is one.

    Raises: GridSimError for a missing device.
    """
    if name == "cpu" or (name == "auto" and not torch.cuda.is_available()):
        return torch.device("cpu")
    if not torch.cuda.is_available():
        raise GridSimError(f"PyTorch finds no device {name!r} here; use --device cpu")
    return torch.device("cuda", 0)


@contextmanager
def one_thread() -> Iterator[None]:
    """Have PyTorch use one thread: results depend on the number of threads, and the workers need the other cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@njit(nogil=True)
def _squash(x):
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, j] = squash(x[i, j])


class Squash(torch.autograd.Function):
    """Hyperbolic tangent on the CPU, in place, by the policies' `squash`: 5 us for 256 x 64; torch.tanh takes 45."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor) -> torch.Tensor:
        """Args: x float32 [n, m], contiguous."""
        _squash(x.numpy())
        ctx.mark_dirty(x)
        ctx.save_for_backward(x)
        return x

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> torch.Tensor:
        """The derivative is that of the hyperbolic tangent, 1 - y^2."""
        (y,) = ctx.saved_tensors
        return torch.addcmul(gradients[0], gradients[0] * y, y, value=-1.0)


def tanh(x: torch.Tensor) -> torch.Tensor:
    """Hyperbolic tangent of x float32 [n, m], contiguous, which it may overwrite."""
    if x.device.type != "cpu":
        return torch.tanh(x)
    if x.requires_grad:
        return Squash.apply(x)
    _squash(x.numpy())
    return x


class QNetwork:
    """A policy's network in PyTorch. Its parameters are one genome; the layers are views of it."""

    def __init__(self, spec: PolicySpec, device: torch.device):
        self.spec = spec
        self.genome = torch.zeros(spec.size, device=device)
        self.layers = layers_of(spec, self.genome)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Values float32 [n, outputs] of the actions for inputs float32 [n, inputs]."""
        if isinstance(self.spec, CnnSpec):
            return self._convolutional(self.spec, x)
        *hidden, (weights, biases) = self.layers
        for layer_weights, layer_biases in hidden:
            x = tanh(torch.addmm(layer_biases, x, layer_weights))
        return torch.addmm(biases, x, weights)

    def _convolutional(self, spec: CnnSpec, x: torch.Tensor) -> torch.Tensor:
        one, two, _ = spec.hidden
        (w1, b1), (w2, b2), (w3, b3), (w4, b4) = self.layers
        frames, speed = x[:, :-1].reshape(-1, spec.frames, CELLS, CELLS), x[:, -1:]
        # A genome orders a unit's inputs (frame, row, column) in the first layer, (row, column, channel) in the second.
        w1 = w1.view(spec.frames, KERNEL_1, KERNEL_1, one).permute(3, 0, 1, 2)
        w2 = w2.view(KERNEL_2, KERNEL_2, one, two).permute(3, 2, 0, 1)
        x = torch.relu(torch.nn.functional.conv2d(frames, w1, b1, stride=STRIDE_1))
        x = torch.relu(torch.nn.functional.conv2d(x, w2, b2, stride=STRIDE_2))
        x = torch.cat([x.permute(0, 2, 3, 1).flatten(1), speed], dim=1)
        return torch.addmm(b4, torch.relu(torch.addmm(b3, x, w3)), w4)


def new_weights(spec: PolicySpec, seed: int) -> np.ndarray:
    """An initial genome float32 [genes]: uniform within 1 / sqrt(inputs of the unit), as in Mnih et al. (2015)."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, _WEIGHTS]))
    bounds = np.concatenate([np.full((n + 1) * m, 1.0 / math.sqrt(n)) for n, m in spec.shapes()])
    return (rng.uniform(-1.0, 1.0, spec.size) * bounds).astype(np.float32)


class DqnLearner:
    """A Q network in training; `seed` decides its initial weights and the transitions that are drawn.

    Raises: GridSimError for a missing device (`device_of`).
    """

    def __init__(self, spec: PolicySpec, config: DqnConfig, seed: int, device: str = "cpu"):
        self.spec, self.config = spec, config
        self.device = device_of(device)
        self.updates = 0
        self.online, self.target = QNetwork(spec, self.device), QNetwork(spec, self.device)
        self._leaves = [tensor.requires_grad_() for layer in self.online.layers for tensor in layer]
        self._gradient, self._average, self._mean, self._variance = (
            torch.zeros(spec.size, device=self.device) for _ in range(4)
        )
        self._steps = torch.zeros((), device=self.device)
        self._checkpointed = {  # each float32 [genes]
            "weights": self.online.genome, "target": self.target.genome, "average": self._average,
            "adam_mean": self._mean, "adam_variance": self._variance,
        }  # fmt: skip
        self._key = int(np.random.SeedSequence([seed, _SAMPLES]).generate_state(1, np.uint64)[0])
        self.load_weights(new_weights(spec, seed))

    @property
    def weights(self) -> np.ndarray:
        """The network as a genome: float32 [genes], a copy."""
        return self.online.genome.cpu().numpy().copy()

    @property
    def average(self) -> np.ndarray:
        """The average genome of the latest updates; it drives better than the last one: float32 [genes], a copy."""
        return self._average.cpu().numpy().copy()

    def load_weights(self, genome: np.ndarray) -> None:
        """Set network, target network and average to a genome float32 [genes], with which training begins."""
        for tensor in (self.online.genome, self.target.genome, self._average):
            tensor.copy_(torch.from_numpy(genome))

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        """A copy on the device. Rounding depends on alignment, and PyTorch aligns copies alike in all processes."""
        return torch.from_numpy(array).to(self.device, copy=True)

    def targets(self, batch: Batch) -> torch.Tensor:
        """Targets y [n] for the values of a batch's actions, without gradients."""
        with torch.no_grad():
            following = self._tensor(batch.next_observations)
            best = self.online(following).argmax(dim=1, keepdim=True)
            values = self.target(following).gather(1, best).squeeze(1)
            return torch.addcmul(self._tensor(batch.rewards), self._tensor(batch.discounts), values)

    def loss(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor]:
        """The loss [] of a batch, with gradients, and the values [n] of its actions, without gradients."""
        y, actions = self.targets(batch), self._tensor(batch.actions)[:, None]
        q = self.online(self._tensor(batch.observations)).gather(1, actions).squeeze(1)
        return torch.nn.functional.huber_loss(q, y, delta=self.config.huber_delta), q.detach()

    def update(self, batch: Batch) -> tuple[float, float]:
        """Make one update from a batch. Returns: its loss, and the mean value of its actions.

        Raises: FloatingPointError if the network has diverged.
        """
        loss, q = self.loss(batch)
        finite(loss.item(), self.updates)
        gradients = torch.autograd.grad(loss, self._leaves)
        torch.cat([gradient.flatten() for gradient in gradients], out=self._gradient)
        norm = torch.linalg.vector_norm(self._gradient)
        self._gradient.mul_((self.config.gradient_clip / norm).clamp_(max=1.0))
        learning_rate, epsilon = self.config.learning_rate_at(self.updates), self.config.adam_epsilon
        _adam(
            [self.online.genome], [self._gradient], [self._mean], [self._variance], [], [self._steps],
            lr=learning_rate, eps=epsilon,
        )  # fmt: skip
        self.updates += 1
        self._average.lerp_(self.online.genome, 1.0 / min(self.updates, self.config.average))
        if self.updates % self.config.target_period == 0:
            self.target.genome.copy_(self.online.genome)
        return loss.item(), q.mean().item()

    @one_thread()
    def train(self, replay: Replay, updates: int) -> tuple[float, float]:
        """Make 1 or more updates from a replay; n and then m of them lead to the same weights as n + m at once.

        Returns: mean loss and mean value.
        Raises: ValueError if the replay has no transitions; FloatingPointError as `update`.
        """
        made = []
        for _ in range(updates):
            key = (self._key + self.updates) % (1 << 64)
            made.append(self.update(replay.sample(key, self.config.batch)))
        loss, q = np.mean(made, axis=0)
        return float(loss), float(q)

    @one_thread()
    def q_values(self, observations: np.ndarray) -> np.ndarray:
        """Values float32 [n, outputs] of the actions for the network's inputs float32 [n, inputs]."""
        with torch.no_grad():
            return self.online(self._tensor(observations)).cpu().numpy()

    def state(self) -> dict[str, np.ndarray]:
        """The learner's state as copied arrays."""
        arrays = {name: tensor.cpu().numpy().copy() for name, tensor in self._checkpointed.items()}
        return arrays | {"updates": np.array(self.updates)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore a `state` of a learner with the same network."""
        for name, tensor in self._checkpointed.items():
            tensor.copy_(torch.from_numpy(arrays[name].reshape(self.spec.size)))
        self.updates = int(arrays["updates"])
        self._steps.fill_(self.updates)
