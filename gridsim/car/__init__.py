"""The ego car: vehicle models, actions, reward."""
