"""A second renderer, Cycles, renders the worlds: by how much it differs from ours, and why."""
