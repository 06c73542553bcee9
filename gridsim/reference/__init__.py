"""The reference driver, and the errors of other drives relative to it."""
