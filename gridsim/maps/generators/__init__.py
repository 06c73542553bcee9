"""The scenarios' generators: each lays out a map from a random generator."""
