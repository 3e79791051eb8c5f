"""Recordings on disk, written during the capture."""
