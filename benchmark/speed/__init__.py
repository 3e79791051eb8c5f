"""What all speed measurements share, and those of this room."""
