"""What MLflow gets of a training run's folder: rows, files, champion, and the words that describe them."""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cluster.settings import SETTINGS, RunSettings, from_dict
from cluster.store.champion import load_champion
from cluster.store.folder import FILES
from cluster.text import cars, km_per_collision
from cluster.tracking.address import TrackingError
from cluster.tracking.content import CHAMPION_TAG, Content, Model
from evolution.networks.export import example
from evolution.networks.policy import PolicySpec
from gridsim.errors import GridSimError
from gridsim.maps.parts import roads_of
from gridsim.maps.scenarios import label

NOT_LOGGED = ("target_m",)  # columns of history.csv that are not metrics


def read_run(folder: Path) -> Content | None:
    """What MLflow is to have of a run by now; None before its first row.

    Raises: GridSimError with one line if a file is damaged, or if config.json is missing.
    """
    path = folder / "history.csv"
    try:
        rows = read_rows(path) if path.is_file() else []
        path = folder / "config.json"
        config = json.loads(path.read_bytes())
        settings = from_dict(SETTINGS[config["command"]], dict(config["settings"]))
        path = folder / "summary.json"
        summary = json.loads(path.read_bytes()) if path.is_file() else None
        model = None
        if summary:
            held_out, step, wall_s = held_out_metrics(summary), len(rows), float(summary["wall_s"])
            # The champion is chosen after the last step, so its validation is one more row.
            last = {"validation/success_rate": float(summary["validation_success_rate"])}
            rows += [(step - 1, held_out, wall_s), (step, last, wall_s)]
            path = folder / "champion.npz"
            model = onnx_model(folder, settings, held_out)
    except (OSError, LookupError, TypeError, ValueError) as error:  # edited by hand, or cut off
        if isinstance(error, GridSimError):
            raise
        what = f"{path} is damaged ({type(error).__name__}: {error}); delete it and {folder / 'summary.json'}"
        raise TrackingError(f"{what}, and make them again with --resume {shlex.quote(str(folder))}") from error
    if not rows:
        return None
    return Content(
        name=folder.name,
        params={name: str(value) for name, value in asdict(settings).items()},
        tags=tags(settings),
        rows=rows,
        note=f"{headline(settings)}\n\nIts folder: `{folder}`",
        result=result(folder, settings, summary) if summary else "",
        files=[folder / name for name in FILES if (folder / name).is_file()] if summary else [],
        model=model,
        finished=summary is not None,
        wall_s=rows[-1][2],
    )


def read_rows(path: Path) -> list[tuple[int, Mapping[str, float], float]]:
    """Step, metrics and wall_s of each complete line of a history.csv."""
    text = path.read_text(encoding="utf-8")
    columns, *lines = csv.reader(io.StringIO(text[: text.rfind("\n") + 1]))
    rows = [dict(zip(columns, map(float, line), strict=True)) for line in lines]
    return [
        (int(row[columns[0]]), {name: row[name] for name in columns[1:] if name not in NOT_LOGGED}, row["wall_s"])
        for row in rows
    ]


def group(settings: RunSettings) -> str:
    """Words that are the same for runs that differ only in seed and limits.

    They name road, learner, network, traffic if there is any, and other settings that are not the defaults.
    """
    words = [label(settings.scenario), settings.algorithm, settings.policy]
    words += [cars(settings.traffic)] if settings.traffic else []
    given = asdict(settings)
    usual = asdict(type(settings)(settings.scenario, settings.traffic, observation=settings.observation))
    left_out = {"seed", "policy", "actions", "search", *settings.extendable}  # varied, named above, or only limits
    more = [f"{name} {value}" for name, value in given.items() if name not in left_out and value != usual[name]]
    return ", ".join([" ".join(words), *more])


def tags(settings: RunSettings) -> dict[str, str]:
    """MLflow's tags, by which runs are found and grouped besides their parameters; the seed is in none of them."""
    return {
        "algorithm": "dqn" if settings.algorithm == "dqn" else "evolution",
        "scenario": settings.scenario if len(roads_of(settings.scenario)) == 1 else label(settings.scenario),
        "group": group(settings),
    }


def held_out_metrics(summary: Mapping[str, Any]) -> dict[str, float]:
    """The held-out figures of a summary.json, except `episodes`, by the names of MLflow's metrics.

    With several roads, they are followed by the same figures of each road.
    """
    roads = {"": summary["held_out"]}
    if len(by_road := summary.get("held_out_by_road", {})) > 1:
        roads |= {f"{_plain(road)}/": figures for road, figures in by_road.items()}
    return {
        f"held_out/{road}{name}": float(value)
        for road, figures in roads.items()
        for name, value in figures.items()
        if name != "episodes"
    }


def _plain(road: str) -> str:
    """A road's label as a part of MLflow's names: all but letters, digits, "_", "." and "-" become "_".

    MLflow would take an @ for an alias.
    """
    return re.sub(r"[^\w.-]", "_", road)


def model_name(settings: RunSettings) -> str:
    """Name of the registered model whose versions are the champions of this algorithm on this scenario."""
    return f"gridsim-{_plain(label(settings.scenario))}-{settings.algorithm}"


def headline(settings: RunSettings) -> str:
    """What a run does, in one line."""
    verb = {"dqn": "Deep Q-learning", "random": "Random search"}.get(settings.algorithm, "Evolution")
    among = f"among {cars(settings.traffic)}" if settings.traffic else "without traffic"
    return f"{verb} of a `{settings.policy}` driver on **{label(settings.scenario)}**, {among}, seed {settings.seed}."


def result(folder: Path, settings: RunSettings, summary: Mapping[str, Any]) -> str:
    """A finished run's results and how to watch, load and repeat it, Markdown."""
    held_out, spec = summary["held_out"], PolicySpec.parse(settings.policy)
    takes = "observations" if spec.observation == "rays" else '{"grid": grids, "speed": speeds}'
    found = "Solved" if summary["solved"] else "The best so far"
    step = f"{settings.step_name}s"
    return "\n\n".join([
        f"{found} after {summary[step]:,} {step}, {summary['car_steps'] / 1e6:,.1f} million car-steps and "
        f"{summary['wall_s']:,.0f} s. On {held_out['episodes']} held-out drives the champion succeeds in "
        f"**{held_out['success_rate']:.1%}**, drives {held_out['distance_m']:,.0f} m at {held_out['speed_mps']:.2f} "
        f"m/s, and collides in {held_out['collision_rate']:.1%}: {km_per_collision(held_out)} km per collision.",
        "Watch it: `drive.html` among the artifacts, or",
        f"    gridsim-watch {shlex.quote(str(folder))}",
        f"Load it, an ONNX model from the environment's observations to its actions, n at a time, registered as "
        f"`{model_name(settings)}`:",
        f'    mlflow.pyfunc.load_model("runs:/{{run_id}}/model").predict({takes})["action"]',
        f"Repeat the run: `{settings.command} --config config.json`.",
    ])  # fmt: skip


def onnx_model(folder: Path, settings: RunSettings, held_out: Mapping[str, float]) -> Model | None:
    """A finished run's champion and the words for its registered version; None without a champion.onnx."""
    if not (folder / "champion.onnx").is_file():
        return None
    champion = load_champion(folder / "champion.npz")
    return Model(
        model_name(settings),
        about=f"Champions of {settings.command} on {label(settings.scenario)}. They take the environment's "
        "observations and return its action; where it is one of the eight, also a number for each of these.",
        note=f"{headline(settings)} {held_out['held_out/success_rate']:.1%} of the held-out drives succeed.",
        tags={
            CHAMPION_TAG: champion.sha256,
            "policy": champion.policy,
            "scenario": label(settings.scenario),
            "algorithm": settings.algorithm,
            "traffic": str(champion.traffic),
            "seed": str(settings.seed),
            **{name: f"{value:.6g}" for name, value in held_out.items()},
        },
        onnx=folder / "champion.onnx",
        example=example(PolicySpec.parse(champion.policy), champion.sim),
    )
