"""A run's folder, settings, checkpoint and champion."""
