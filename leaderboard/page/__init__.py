"""The page: committed entries and finished runs as static files that a person reads, compares and doubts."""
