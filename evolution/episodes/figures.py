"""Figures of how well a network drives, from the results of its episodes."""

from __future__ import annotations

import numpy as np

from gridsim.state import End


def summarise(results: np.ndarray, period_s: float) -> dict[str, float]:
    """Means over the episodes of one member, RESULT [e]; `period_s` is the control period.

    Kilometres per collision are the kilometres of all episodes, divided by their collisions. Without a collision, the
    figure is the kilometres of all episodes, which is a lower bound.
    """
    kilometres, collisions = results["distance"].sum(dtype=np.float64) / 1000.0, results["end"] == End.COLLISION
    return {
        "episodes": len(results),
        "success_rate": float((results["end"] == End.SUCCESS).mean()),
        "distance_m": float(results["distance"].mean()),
        "speed_mps": mean_speed(results, period_s),
        "collision_rate": float(collisions.mean()),
        "km_per_collision": float(kilometres / max(int(collisions.sum()), 1)),
    }


def mean_speed(results: np.ndarray, period_s: float) -> float:
    """Mean speed in m/s: new ground divided by time, averaged over episodes."""
    seconds = np.maximum(results["steps"].astype(np.float64), 1.0) * period_s
    return float((results["distance"] / seconds).mean())
