"""Spikes against frames against events: one scene, three sensors, and what each costs in bits per second."""
