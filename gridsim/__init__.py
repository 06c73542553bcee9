"""GridSim's simulator: arrays in, arrays out. Knows nothing of learning, Ray, MLflow or files of a run.

Importing it registers Gymnasium's environments, which takes milliseconds: Numba and the roads are loaded when one is
made. `gymnasium.make("gridsim:GridSim/City-v0")` imports it by itself.
"""

from gymnasium.envs.registration import register as _register

ENVIRONMENTS = {
    "GridSim/Highway-v0": "highway",
    "GridSim/Curved-v0": "curved",
    "GridSim/Seamless-v0": "seamless",
    "GridSim/Roundabout-v0": "roundabout",
    "GridSim/City-v0": "city",
}
"""Scenarios by their environments' ids."""

for _id, _scenario in ENVIRONMENTS.items():
    _register(
        id=_id,
        entry_point="gridsim.envs.env:GridSimEnv",
        vector_entry_point="gridsim.envs.env:GridSimVectorEnv",
        kwargs={"scenario": _scenario},
    )
