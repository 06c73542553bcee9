"""How MLflow describes a training run: its name, parameters, tags, description, and its champion."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from cluster.settings import RunSettings
from cluster.tracking.mlflow_run import MODEL, RUN_ID, Model
from evolution.networks.policy import PolicySpec
from gridsim.maps.scenarios import label

if TYPE_CHECKING:
    import numpy as np
    import torch

    from cluster.store.champion import Champion
    from cluster.store.folder import RunFolder


def group(settings: RunSettings) -> str:
    """What runs that differ only in their seeds have in common, in words."""
    words = [label(settings.scenario), settings.algorithm, settings.policy]
    words += [f"{settings.traffic} cars"] if settings.traffic else []
    given = asdict(settings)
    usual = asdict(type(settings)(settings.scenario, settings.traffic, observation=settings.observation))
    left_out = {"seed", "policy", "search", *settings.unbound}  # varied, named above, or only limits
    more = [f"{name} {value}" for name, value in given.items() if name not in left_out and value != usual[name]]
    return ", ".join([" ".join(words), *more])


def params(settings: RunSettings) -> dict[str, str]:
    """All that decides the champion; what follows from this, and the simulator's constants, are in config.json."""
    return {name: str(value) for name, value in asdict(settings).items()}


def tags(settings: RunSettings) -> dict[str, str]:
    """What runs are found and grouped by, besides their parameters; `group` is all but the seed."""
    return {
        "algorithm": "dqn" if settings.algorithm == "dqn" else "evolution",
        "scenario": settings.scenario,
        "group": group(settings),
    }


def held_out_metrics(figures: Mapping[str, float]) -> dict[str, float]:
    """Held-out figures under MLflow's names."""
    return {f"held_out/{name}": float(value) for name, value in figures.items() if name != "episodes"}


def model_name(settings: RunSettings) -> str:
    """The registered model whose versions are the champions of such runs."""
    road = re.sub(r"[^\w.-]", "_", label(settings.scenario))  # an @ would be read as an alias
    return f"gridsim-{road}-{settings.algorithm}"


def headline(settings: RunSettings) -> str:
    """What a run does, in one line."""
    verb = {"dqn": "Deep Q-learning", "random": "Random search"}.get(settings.algorithm, "Evolution")
    cars = f"among {settings.traffic} cars" if settings.traffic else "without traffic"
    return f"{verb} of a `{settings.policy}` driver on **{label(settings.scenario)}**, {cars}, seed {settings.seed}."


def describe(run: RunFolder, summary: Mapping[str, Any] | None = None) -> str:
    """A run's description, Markdown: what it does, and once it is finished its results and how to watch it."""
    settings, folder = run.settings, run.path
    if summary is None:
        return f"{headline(settings)}\n\nIts folder: `{folder}`"
    held_out, inputs = summary["held_out"], PolicySpec.parse(settings.policy).inputs
    found = "Solved" if summary["solved"] else "The best so far"
    step = next(name for name in ("generations", "evaluations") if name in summary)
    return "\n\n".join([
        headline(settings),
        f"{found} after {summary[step]:,} {step}, {summary['car_steps'] / 1e6:,.1f} million car-steps and "
        f"{summary['wall_s']:,.0f} s. On {held_out['episodes']} held-out drives the champion succeeds in "
        f"**{held_out['success_rate']:.1%}**, drives {held_out['distance_m']:,.0f} m at {held_out['speed_mps']:.2f} "
        f"m/s, and collides in {held_out['collision_rate']:.1%}.",
        "Watch it: `drive.html` among the artifacts, or",
        f"    gridsim-watch {shlex.quote(str(folder))}",
        f"Load it, a torch model of the environment's observations, float32 [n, {inputs}], which is registered as "
        f"`{model_name(settings)}`:",
        f'    mlflow.pytorch.load_model("runs:/{RUN_ID}/{MODEL}")',
        f"Repeat the run: `{settings.command} --config config.json`.",
    ])  # fmt: skip


def torch_model(champion: Champion, settings: RunSettings, held_out: Mapping[str, float]) -> Model:
    """The champion as a torch model, with the description of its registered version."""

    def build() -> tuple[torch.nn.Module, np.ndarray]:
        from evolution.networks.export import example, to_torch

        spec = PolicySpec.parse(champion.policy)
        return to_torch(spec, champion.genome, champion.sim), example(spec, champion.sim)

    return Model(
        model_name(settings),
        champion.sha256,
        about=f"Champions of {settings.command} on {label(settings.scenario)}. They take the environment's "
        "observations and return a number for each of the eight actions; the action with the greatest is taken.",
        note=f"{headline(settings)} {held_out['success_rate']:.1%} of the held-out drives succeed.",
        tags={
            "policy": champion.policy,
            "scenario": label(settings.scenario),
            "algorithm": settings.algorithm,
            "traffic": str(champion.traffic),
            "seed": str(settings.seed),
            **{name: f"{value:.6g}" for name, value in held_out_metrics(held_out).items()},
        },
        build=build,
    )
