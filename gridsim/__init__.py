"""GridSim's simulator: arrays in, arrays out. It does not depend on learning, Ray, MLflow or run folders.

Importing it registers the Gymnasium environments. That takes milliseconds, because Numba and the maps are loaded only
when an environment is made. `gymnasium.make("gridsim:GridSim/City-v0")` imports it implicitly.
"""

from gymnasium.envs.registration import register as _register

ENVIRONMENTS = {
    "GridSim/Highway-v0": "highway",
    "GridSim/Curved-v0": "curved",
    "GridSim/Seamless-v0": "seamless",
    "GridSim/Roundabout-v0": "roundabout",
    "GridSim/City-v0": "city",
}
"""The scenario of each environment id."""

for _id, _scenario in ENVIRONMENTS.items():
    _register(
        id=_id,
        entry_point="gridsim.envs.env:GridSimEnv",
        vector_entry_point="gridsim.envs.env:GridSimVectorEnv",
        kwargs={"scenario": _scenario},
    )
