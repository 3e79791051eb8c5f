"""Bounds of what a file may state, and readers of container formats that hold to them: files come from others."""
