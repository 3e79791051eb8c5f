"""Releases: scenes packed into a few large files, which people download whole or in part."""
