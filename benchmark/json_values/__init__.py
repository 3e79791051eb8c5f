"""JSON values: their text, read strictly and written always alike, and schemas that check them fast."""
