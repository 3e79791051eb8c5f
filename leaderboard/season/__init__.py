"""Hidden seasons: scenes that are committed to by their hashes, scored without a server, and revealed at the end."""
