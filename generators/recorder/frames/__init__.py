"""Conversion of bytes to frames with true ticks: layouts, rings, losses, clips."""
