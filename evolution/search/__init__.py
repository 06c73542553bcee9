"""Searches (ask and tell), which recombine all winners or two parents; breeding from recipes; spaces of genes."""
