"""Imperfections of a real array: clocks that drift apart, unequal gains, bad pixels."""
