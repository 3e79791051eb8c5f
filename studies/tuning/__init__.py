"""The same search for every row: its knobs, its trials, and what it found."""
