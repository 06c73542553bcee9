"""Sensors: range rays, other cars as boxes, the occupancy grid."""
