"""Rendering with Mitsuba: scene objects, visibility, key frames, soft light."""
