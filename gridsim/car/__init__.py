"""The ego car: bicycle model, control step, end of an episode, reward."""
