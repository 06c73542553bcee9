"""GridSim's learning: pure algorithms over flat genomes. Independent of Ray, MLflow and files."""
