"""Speed measurements: the parts that all share, and those of this room."""
