"""GridSim's simulator: arrays in, arrays out. It does not depend on learning, Ray, MLflow or run folders.

Importing it registers the Gymnasium environments. That takes milliseconds, because Numba and the maps are loaded only
when an environment is made. `gymnasium.make("gridsim:GridSim/City-v0")` imports it implicitly.

`gridsim.SimConfig`, and `gridsim.evolve` and the other names of `cluster.api`, are loaded on first use: users look for
them here, but the simulator must not import what trains in it.
"""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from pkgutil import iter_modules as _iter_modules
from typing import Any as _Any

from gymnasium.envs.registration import register as _register

_GENERATORS = str(_Path(__file__).parent / "maps" / "generators")
ENVIRONMENTS = {f"GridSim/{file.name.title()}-v0": file.name for file in _iter_modules([_GENERATORS])}
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
    if name == "SimConfig":
        return _import_module("gridsim.config").SimConfig
    if name in _API:
        _import_module("gridsim.packages").check_packages()
        return getattr(_import_module(_API_MODULE), name)
    raise AttributeError(f"module 'gridsim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), "SimConfig", *_API]
