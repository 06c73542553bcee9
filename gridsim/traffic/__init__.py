"""The other cars: state and spawning, car following and lane changes, junctions, meeting the ego car."""
