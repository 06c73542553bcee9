"""Pictures, the window, manual driving and recorded drives."""
