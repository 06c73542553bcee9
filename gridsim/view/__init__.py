"""Pictures, the window, a person at the keys and recorded drives."""
