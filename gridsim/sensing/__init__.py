"""What the car sees: range rays, other cars as boxes, the occupancy grid."""
