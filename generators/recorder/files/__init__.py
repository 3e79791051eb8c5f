"""Recordings on disk, written while they grow."""
