"""Which episodes are driven, and driving them."""
