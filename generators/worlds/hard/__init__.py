"""Worlds of content that can break a method: one file a world, each hard for one reason."""
