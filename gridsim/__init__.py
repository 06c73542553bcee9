"""GridSim's simulator: arrays in, arrays out. Knows nothing of learning, Ray, MLflow or files of a run."""
