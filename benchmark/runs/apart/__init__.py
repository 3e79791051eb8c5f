"""Fits that see a training part alone: what the part holds, the process that fits from it, and its caller."""
