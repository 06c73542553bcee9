"""The DQN learner: a Q network, its target network, and their updates. The only file with gradients.

The Q network is a policy: it has the shape of a `PolicySpec`, its parameters are a genome, and its 8 outputs are the
actions' values. So it can drive wherever a policy can.

An update (Mnih et al. 2015, "Human-level control through deep reinforcement learning") takes a batch from the replay
and moves Q(s_t, a_t) towards

    y = R_t + discount^m Q_target(s_{t+m}, argmax_a Q(s_{t+m}, a))

with the n-step return R_t (`replay`), the action chosen by the network and valued by the target: Double DQN (van
Hasselt et al. 2016, "Deep Reinforcement Learning with Double Q-learning"), or both by the target where `double` is off.
The loss is Huber's, the optimiser Adam (Kingma and Ba 2015).

The result depends only on the seed, the parameters and the replay's contents. The random numbers of update u depend on
(seed, u), so training may be split into blocks of any size. On the CPU, results are bit-identical in all processes on
one type of machine.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.optim.adam import adam

from evolution.dqn.replay import Batch, PriorityConfig, Replay
from evolution.networks.policy import CELLS, KERNEL_1, KERNEL_2, STRIDE_1, STRIDE_2, CnnSpec, PolicySpec, squash
from gridsim.jit import njit

_WEIGHTS, _SAMPLES = 0, 1  # purposes of random numbers


@dataclass(frozen=True)
class DqnConfig:
    """The learner's parameters, beside those of the network and of the `Replay`, which computes the returns."""

    batch: int = 256  # transitions of an update
    learning_rate: float = 1e-3  # Adam's, at the beginning
    final_learning_rate: float = 0.1  # its final value, relative to that
    learning_rate_updates: int = 50_000  # over which it falls linearly
    adam_epsilon: float = 1e-5  # Adam's; greater than its authors' 1e-8 since squared gradients are small (Rainbow)
    target_period: int = 500  # updates between copies of the network to the target
    average: int = 2000  # time constant, in updates, of the exponential average of weights (Polyak and Juditsky 1992)
    double: bool = True  # Double DQN
    # Error above which the loss is linear: as large as returns. With 1 (Mnih et al. 2015), the large error of a rare
    # crash hardly counts: values become medians instead of means, and drivers reckless.
    huber_delta: float = 30.0
    gradient_clip: float = 10.0  # greatest norm of a gradient (Wang et al. 2016, "Dueling Network Architectures")
    priorities: PriorityConfig | None = None  # None draws transitions uniformly

    def check(self) -> None:
        """Raises ValueError with one line for invalid parameters. `Replay` checks its own."""
        for name in ("batch", "learning_rate_updates", "target_period", "average"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name.replace('_', ' ')} must be 1 or more, not {getattr(self, name)}")
        for name in ("learning_rate", "adam_epsilon", "huber_delta", "gradient_clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name.replace('_', ' ')} must be greater than 0, not {getattr(self, name)}")
        if not 0 <= self.final_learning_rate <= 1:
            raise ValueError(f"final learning rate is a share in [0, 1], not {self.final_learning_rate}")

    def learning_rate_at(self, update: int) -> float:
        """Adam's learning rate in an update, counted from 0."""
        share = min(update / self.learning_rate_updates, 1.0)
        return self.learning_rate * (1.0 + (self.final_learning_rate - 1.0) * share)

    def beta_at(self, update: int) -> float:
        """The exponent of importance weights in an update, counted from 0; 1 without priorities."""
        if self.priorities is None:
            return 1.0
        return self.priorities.beta + (1.0 - self.priorities.beta) * min(update / self.priorities.beta_updates, 1.0)


class Step(NamedTuple):
    """Statistics of an update."""

    loss: float
    q: float  # mean of the chosen actions' values
    error: float  # mean size of the errors
    errors: np.ndarray  # float32 [batch], Q - y


class Training(NamedTuple):
    """Means of the statistics of several updates."""

    loss: float
    q: float  # of the chosen actions' values
    error: float  # size of Q - y


def diverged(update: int) -> FloatingPointError:
    """The error for a network whose loss is no longer finite."""
    return FloatingPointError(f"the Q network diverged at update {update}: try a lower learning rate")


def device_of(name: str) -> torch.device:
    """The device that `auto`, `cpu`, `cuda` or `cuda:N` names; `auto` is cuda where there is one.

    Raises: ValueError with one line for another name, or a missing device.
    """
    found = torch.cuda.device_count() if name != "cpu" and torch.cuda.is_available() else 0
    if name in ("auto", "cuda") and found:
        return torch.device("cuda", 0)
    if name in ("auto", "cpu"):
        return torch.device("cpu")
    kind, _, index = name.partition(":")
    if kind != "cuda" or (index and not index.isdecimal()):
        raise ValueError(f"unknown device {name!r}; write auto, cpu or cuda")
    if int(index or 0) >= found:
        raise ValueError(f"PyTorch finds no device {name!r} here ({found} in all); use --device cpu")
    return torch.device("cuda", int(index))


@njit(nogil=True)
def _squash(x):
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            x[i, j] = squash(x[i, j])


class Squash(torch.autograd.Function):
    """Hyperbolic tangent on the CPU, in place, by the policies' own `squash`: 256 x 64 in 5 us, by torch.tanh in 45."""

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


class QNetwork(torch.nn.Module):
    """A policy's network in PyTorch. Its one parameter is the genome; the layers are views of it.

    So the optimiser's step, a copy to the target and a conversion to a policy are one operation each.
    """

    def __init__(self, spec: PolicySpec, device: torch.device):
        super().__init__()
        self.spec = spec
        self.genome = torch.nn.Parameter(torch.zeros(spec.size, device=device), requires_grad=False)
        self.layers: list[tuple[torch.Tensor, torch.Tensor]] = []  # weights and biases of each
        at = 0
        for n, m in spec.shapes():
            weights, biases = self.genome[at : at + n * m].view(n, m), self.genome[at + n * m : at + (n + 1) * m]
            self.layers.append((weights, biases))
            at += (n + 1) * m

    def leaves(self) -> list[torch.Tensor]:
        """The layers' tensors in the genome's order; sets them to require gradients."""
        return [tensor.requires_grad_() for layer in self.layers for tensor in layer]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Values float32 [n, outputs] of the actions for inputs float32 [n, inputs]."""
        if isinstance(self.spec, CnnSpec):
            return self._on_grids(self.spec, x)
        for weights, biases in self.layers[:-1]:
            x = tanh(torch.addmm(biases, x, weights))
        weights, biases = self.layers[-1]
        return torch.addmm(biases, x, weights)

    def _on_grids(self, spec: CnnSpec, x: torch.Tensor) -> torch.Tensor:
        one, two, _ = spec.hidden
        (w1, b1), (w2, b2), (w3, b3), (w4, b4) = self.layers
        speed = x[:, -1:]
        x = x[:, :-1].reshape(-1, spec.frames, CELLS, CELLS)
        # A genome orders a unit's inputs (frame, row, column), then (row, column, channel).
        w1 = w1.view(spec.frames, KERNEL_1, KERNEL_1, one).permute(3, 0, 1, 2)
        x = torch.relu(torch.nn.functional.conv2d(x, w1, b1, stride=STRIDE_1))
        w2 = w2.view(KERNEL_2, KERNEL_2, one, two).permute(3, 2, 0, 1)
        x = torch.relu(torch.nn.functional.conv2d(x, w2, b2, stride=STRIDE_2))
        x = torch.cat([x.permute(0, 2, 3, 1).flatten(1), speed], dim=1)
        return torch.addmm(b4, torch.relu(torch.addmm(b3, x, w3)), w4)


def new_weights(spec: PolicySpec, seed: int) -> np.ndarray:
    """An initial genome float32 [genes]: uniform within 1 / sqrt(inputs of the unit), as in Mnih et al. (2015)."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, _WEIGHTS]))
    bounds = np.concatenate([np.full((n + 1) * m, 1.0 / math.sqrt(n)) for n, m in spec.shapes()])
    return (rng.uniform(-1.0, 1.0, spec.size) * bounds).astype(np.float32)


class DqnLearner:
    """A Q network in training.

    Args:
        spec: the network's shape.
        seed: of the initial weights and of the samples from the replay.
        device: as for `device_of`.
    Raises: ValueError with one line for invalid parameters or a missing device.
    """

    def __init__(self, spec: PolicySpec, config: DqnConfig, seed: int, device: str = "cpu"):
        config.check()
        # For the whole process: results depend on the number of threads, and the workers use the other cores.
        torch.set_num_threads(1)
        self.spec, self.config, self.seed = spec, config, seed
        self.device = device_of(device)
        self.updates = 0
        self.online, self.target = QNetwork(spec, self.device), QNetwork(spec, self.device)
        self._leaves = self.online.leaves()
        self._gradient = torch.zeros(spec.size, device=self.device)
        # Adam's moments and steps.
        self._mean, self._variance = torch.zeros_like(self._gradient), torch.zeros_like(self._gradient)
        self._steps = torch.zeros((), device=self.device)
        self._average = torch.zeros_like(self._gradient)
        self._key = int(np.random.SeedSequence([seed, _SAMPLES]).generate_state(1, np.uint64)[0])
        self.load_weights(new_weights(spec, seed))

    @property
    def weights(self) -> np.ndarray:
        """The network as a genome: float32 [genes], a copy."""
        return self.online.genome.detach().cpu().numpy().copy()

    @property
    def average(self) -> np.ndarray:
        """The average of the network over its latest updates, as a genome: float32 [genes], a copy.

        It drives better than the network itself, which fluctuates from update to update.
        """
        return self._average.cpu().numpy().copy()

    def load_weights(self, genome: np.ndarray) -> None:
        """Restart training from a genome [genes].

        Raises: ValueError with one line if its size is wrong or a gene is not finite.
        """
        if genome.shape != (self.spec.size,) or not np.isfinite(genome).all():
            raise ValueError(f"a genome of {self.spec} has {self.spec.size} finite genes, not {list(genome.shape)}")
        zeros = np.zeros(self.spec.size, dtype=np.float32)
        weights = genome.astype(np.float32)
        self._become(weights, weights, weights, zeros, zeros, 0)

    def _become(
        self,
        weights: np.ndarray,
        target: np.ndarray,
        average: np.ndarray,
        mean: np.ndarray,
        variance: np.ndarray,
        updates: int,
    ) -> None:
        # Copied into memory allocated by PyTorch: the alignment of NumPy's memory differs between processes, and the
        # rounding of matrix products depends on it.
        self.online.genome.data.copy_(torch.from_numpy(weights))
        self.target.genome.data.copy_(torch.from_numpy(target))
        self._average.copy_(torch.from_numpy(average))
        self._mean.copy_(torch.from_numpy(mean))
        self._variance.copy_(torch.from_numpy(variance))
        self._steps.fill_(updates)
        self.updates = updates

    def _tensor(self, array: np.ndarray) -> torch.Tensor:
        """A copy on the device, in aligned memory (see `_become`)."""
        return torch.from_numpy(array).to(self.device, copy=True)

    def loss(self, batch: Batch) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """The loss [] of a batch, with gradients; the taken actions' values [n] and their errors Q - y [n]."""
        observations, actions = self._tensor(batch.observations), self._tensor(batch.actions)[:, None]
        with torch.no_grad():
            following = self._tensor(batch.next_observations)
            values = self.target(following)
            best = (self.online(following) if self.config.double else values).argmax(dim=1, keepdim=True)
            ahead = values.gather(1, best).squeeze(1)
            y = torch.addcmul(self._tensor(batch.returns), self._tensor(batch.bootstraps), ahead)
        q = self.online(observations).gather(1, actions).squeeze(1)
        huber = torch.nn.functional.huber_loss(q, y, reduction="none", delta=self.config.huber_delta)
        return torch.dot(self._tensor(batch.weights), huber) / len(q), q.detach(), q.detach() - y

    def update(self, batch: Batch) -> Step:
        """Make one update from a batch.

        Raises: FloatingPointError with one line if the network has diverged.
        """
        loss, q, errors = self.loss(batch)
        step = Step(loss.item(), q.mean().item(), errors.abs().mean().item(), errors.cpu().numpy())
        if not math.isfinite(step.loss):
            raise diverged(self.updates)
        gradients = torch.autograd.grad(loss, self._leaves)
        torch.cat([gradient.flatten() for gradient in gradients], out=self._gradient)
        norm = torch.linalg.vector_norm(self._gradient)
        self._gradient.mul_((self.config.gradient_clip / norm).clamp_(max=1.0))
        self._adam_step(self.config.learning_rate_at(self.updates))
        self.updates += 1
        self._average.lerp_(self.online.genome.detach(), 1.0 / min(self.updates, self.config.average))
        if self.updates % self.config.target_period == 0:
            self.target.genome.data.copy_(self.online.genome.data)
        return step

    def _adam_step(self, learning_rate: float) -> None:
        """PyTorch's Adam as a function, because the overhead of its class exceeds the time of the step."""
        adam(
            [self.online.genome],
            [self._gradient],
            [self._mean],
            [self._variance],
            [],
            [self._steps],
            fused=True,
            amsgrad=False,
            beta1=0.9,
            beta2=0.999,
            lr=learning_rate,
            weight_decay=0.0,
            eps=self.config.adam_epsilon,
            maximize=False,
        )

    def train(self, replay: Replay, updates: int) -> Training:
        """Make `updates` updates from a replay. Splitting them over several calls gives the same result.

        Raises: ValueError if the replay has no transitions; FloatingPointError as `update`.
        """
        sums = [0.0, 0.0, 0.0]
        for _ in range(updates):
            key = (self._key + self.updates) % (1 << 64)
            batch = replay.sample(key, self.config.batch, self.config.beta_at(self.updates))
            step = self.update(batch)
            if replay.prioritised is not None:
                replay.update_priorities(batch.rows, step.errors)
            sums = [total + number for total, number in zip(sums, step[:3], strict=True)]
        return Training(*(total / max(updates, 1) for total in sums))

    def q_values(self, observations: np.ndarray) -> np.ndarray:
        """Values float32 [n, outputs] of the actions for the network's inputs float32 [n, inputs]."""
        with torch.no_grad():
            return self.online(self._tensor(observations)).cpu().numpy()

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The learner's state as copied arrays and plain numbers."""
        tensors = {
            "weights": self.online.genome,
            "target": self.target.genome,
            "average": self._average,
            "adam_mean": self._mean,
            "adam_variance": self._variance,
        }
        arrays = {name: tensor.detach().cpu().numpy().copy() for name, tensor in tensors.items()}
        return arrays, {"updates": self.updates}

    def restore(self, arrays: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> None:
        """Restore a `state`; other names in it are ignored.

        Raises: ValueError with one line if the state is not one of such a learner; then nothing is changed.
        """
        updates = meta.get("updates")
        if type(updates) is not int or not 0 <= updates < 1 << 62:
            raise ValueError(f"a saved learner's updates is not a valid count: {str(updates)[:40]!r}")
        found = []
        for name in ("weights", "target", "average", "adam_mean", "adam_variance"):
            array = arrays.get(name)
            if not isinstance(array, np.ndarray) or array.dtype != np.float32 or array.shape != (self.spec.size,):
                raise ValueError(f"a saved learner's {name} is not float32 [{self.spec.size}], as {self.spec} needs")
            if not np.isfinite(array).all() or (name == "adam_variance" and (array < 0).any()):
                raise ValueError(f"a saved learner's {name} has invalid values")
            found.append(array)
        weights, target, average, mean, variance = found
        self._become(weights, target, average, mean, variance, updates)
