"""`report speed-error`: every approximation beside its exact twin, in one run, on one page."""
