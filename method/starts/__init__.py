"""method/starts."""
