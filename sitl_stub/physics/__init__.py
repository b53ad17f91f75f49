"""The vehicle inside the stub: rigid body, rotors, ground, wind, battery, and what the autopilot believes about them.

Everything in here is SI, NED/FRD (world x north, y east, z down; body x forward, y right, z down), radians,
Hamilton quaternions scalar first, body to world. Nothing here knows MAVLink or a clock.
"""
