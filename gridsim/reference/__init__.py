"""The reference driver's speed and steering, and the errors of drives relative to it."""
