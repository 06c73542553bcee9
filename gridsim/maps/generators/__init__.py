"""The scenarios: each file of this folder is one, named like it. Its `SCENARIO` lays out maps."""
