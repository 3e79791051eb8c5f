"""Estimated poses against the true ones: of scenes, and of bursts in less and less light."""
