"""Packed spike streams on disk: reading, windows and counts, gaps, folders of recordings."""
