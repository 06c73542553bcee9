"""GridSim's simulator: arrays in, arrays out. It does not depend on learning, Ray, MLflow or run folders.

Importing it registers the Gymnasium environments. That takes milliseconds, because Numba and the maps are loaded only
when an environment is made. `gymnasium.make("gridsim:GridSim/City-v0")` imports it implicitly.

`gridsim.evolve` and the other names of `cluster.api` are loaded from there on first use: users look for them here, but
the simulator must not import what trains in it. They need the extra `evolve` (`gridsim.packages`).
"""

from importlib import import_module as _import_module
from typing import Any as _Any

from gymnasium.envs.registration import register as _register

from gridsim.config import SimConfig as SimConfig

ENVIRONMENTS = {f"GridSim/{name.title()}-v0": name for name in ("highway", "curved", "seamless", "roundabout", "city")}
"""The scenario of each environment id."""

_API_MODULE = "cluster.api"
_API = (
    "Champion",
    "DqnSettings",
    "Evaluator",
    "EvolveSettings",
    "compare",
    "evaluate",
    "evolve",
    "load_champion",
    "train_dqn",
)

for _id, _scenario in ENVIRONMENTS.items():
    _register(
        id=_id,
        entry_point="gridsim.envs.env:GridSimEnv",
        vector_entry_point="gridsim.envs.env:GridSimVectorEnv",
        kwargs={"scenario": _scenario},
    )


def __getattr__(name: str) -> _Any:
    if name in _API:
        _import_module("gridsim.packages").check_packages()
        return getattr(_import_module(_API_MODULE), name)
    raise AttributeError(f"module 'gridsim' has no attribute {name!r}")


def __dir__() -> list[str]:
    packages = _import_module("gridsim.packages")
    return [*globals(), *(() if packages.missing("evolve") else _API)]
