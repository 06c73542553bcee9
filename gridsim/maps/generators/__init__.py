"""A builder a scenario: each makes a map from a seed."""
