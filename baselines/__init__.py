"""The systems the paper compares with, composed from shared parts."""
