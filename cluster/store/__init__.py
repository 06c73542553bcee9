"""A run's folder: its configuration, lock, checkpoint, steps and champion."""
