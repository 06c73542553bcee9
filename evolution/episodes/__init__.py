"""Choosing episodes, and driving them."""
