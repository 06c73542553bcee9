"""Networks: what a policy's text means, flat genomes, forward passes, export to PyTorch."""
