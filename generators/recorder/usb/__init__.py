"""Bulk reads over USB, several in flight."""
