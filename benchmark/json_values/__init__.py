"""JSON values as text: read strictly, and written always alike."""
