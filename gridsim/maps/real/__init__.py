"""Real roads from files: OpenStreetMap, OpenDRIVE, SUMO, CommonRoad and Lanelet2, all read into a `RealRoad`."""
