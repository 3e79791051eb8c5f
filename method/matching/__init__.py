"""MSDI with a geometric bottleneck: a network that matches views, and geometry that is solved, not guessed."""
