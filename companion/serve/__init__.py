"""Standing in for the autopilot: clients connect as to the vehicle, and their position setpoints are flown by our law."""
