"""Intrinsics and poses of an array from a moving chessboard."""
