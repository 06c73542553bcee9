"""GridSim's learning: pure algorithms over flat genomes. Knows nothing of Ray, MLflow or files."""
