"""People as the robot sees them: points of what moves in, where each goes out.

`clusters` gathers points on the floor, `filter` holds one constant-velocity Kalman filter a person, `tracker` decides
which points belong to whom. Arrays in, arrays out; no random number anywhere.
"""
