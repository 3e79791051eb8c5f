"""Download from releases: scenes, parts of them, windows of time, and weight files."""
