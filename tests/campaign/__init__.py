"""The fault campaign: thousands of seeded flights of `companion` against `sitl_stub`, judged from outside both.

Neither program imports this one. What is judged is what anybody could see: the wire, the log, the words, the exit code, and
the vehicle's true motion. `scripts/campaign` is the command; docs/campaign.md says what is drawn, what has to hold and what
was found.
"""
