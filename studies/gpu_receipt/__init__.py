"""The receipt of a GPU: its tests, a timing, and where a training step waits for it."""
