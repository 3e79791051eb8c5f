"""Training bursts for networks that learn from many views at once."""
