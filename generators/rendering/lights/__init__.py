"""Light that varies in time."""
