"""References from another program, flown as they come: what a client sends, checked, timed and made smooth."""
