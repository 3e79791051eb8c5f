"""method/images."""
