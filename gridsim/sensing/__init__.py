"""What a car senses: range rays, the occupancy grid, a route; what sensors lack; an observation's features."""
