"""GridSim's environments for Gymnasium and Stable-Baselines3."""
