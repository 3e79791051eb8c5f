"""The metric table and every metric: from a pair of images to values."""
