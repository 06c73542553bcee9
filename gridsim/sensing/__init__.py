"""What a car senses: range rays, the occupancy grid, mirrors, a route; imperfections of sensors; observations."""
