"""The reference driver, and how far a drive is from it."""
