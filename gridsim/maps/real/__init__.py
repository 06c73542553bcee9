"""Real roads from files: OpenStreetMap, OpenDRIVE, SUMO, CommonRoad and Lanelet2, each read into one description."""
