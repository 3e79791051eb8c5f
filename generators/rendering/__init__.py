"""Rendering with Mitsuba: scene objects, visibility, key frames, interpolated light."""
