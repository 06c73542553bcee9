"""GridSim's service: workers, the loop of a run, checkpoints, tracking and the commands."""
