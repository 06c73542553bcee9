"""Batches of cars, and the Gymnasium environments."""
