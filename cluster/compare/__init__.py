"""The paper's comparison: its runs, results and tables."""
