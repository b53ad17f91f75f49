"""Faults on command: what can go wrong with a link, an estimator, a vehicle or its pilot, each named and seeded.

`registry.py` has every kind, `scenario.py` reads them from TOML, `director.py` begins and ends them on a running autopilot.
"""
