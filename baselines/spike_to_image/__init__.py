"""Pictures from spike windows."""
