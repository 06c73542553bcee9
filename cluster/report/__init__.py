"""Pictures, pages and films of runs and drives; how champions drive in the suite and under stress."""
