"""The environments of Gymnasium and Stable-Baselines3."""
