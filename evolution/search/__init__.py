"""Searches (ask and tell): recombination of all winners, two parents; breeding from recipes; spaces."""
