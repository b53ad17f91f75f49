"""The hand-over matrix: every moment of a flight times every way it can end, judged by where the vehicle truly was.

`python -m handover --help` (scripts/handover_matrix). Processes, black box and log reader are the campaign's.
"""
