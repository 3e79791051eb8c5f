"""`report hard-cases`: hard inputs, seeds, interrupted fits and thread counts, each with a measured error."""
