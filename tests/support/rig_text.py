"""A rig profile of two cameras as text, for tests to change; a pose for the end of a camera; and both together."""

RIG = """
schema = "spike4dgs-rig/1"
name = "pair"
width = 40
height = 24
layout = "plain"

[transfer]
bytes = 1024
in_flight = 2

[defaults]
vendor_id = 0x0403
product_id = 0x601f
endpoint_in = 0x82
endpoint_out = 0x01
start = ["00 01"]

[[camera]]
id = "left"
serial = "A1"
role = "primary"

[[camera]]
id = "right"
serial = "A2"
rows = "top-down"
"""

POSE = """
[camera.calibration]
fx = 50
fy = 50.5
cx = 20
cy = 12
rotation = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
translation = [0.1, -2, 3.5]
"""

_LEFT, _RIGHT = RIG.rsplit("\n[[camera]]", 1)
POSED = f"{_LEFT}{POSE}\n[[camera]]{_RIGHT}{POSE}"
