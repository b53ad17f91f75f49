"""The flight log: one MCAP file a flight, written off the control thread, read even when it was cut."""
