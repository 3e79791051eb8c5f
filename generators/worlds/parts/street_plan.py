"""Layout of the street in metres, and the colours that its parts share."""

from __future__ import annotations

from spike4dgs.generators.worlds.primitives.materials import Colour

WHITE: Colour = (0.80, 0.79, 0.76)
DARK: Colour = (0.03, 0.03, 0.035)
ROAD_Y = (-2.6, 5.4)  # near and far kerb
ROAD_X = (-16.0, 16.0)
FRONT_Y = 8.6  # the shop fronts
PAVEMENT_Z = 0.14
