"""Submissions, verification and the committed entries."""
