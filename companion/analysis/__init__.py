"""What a flight was worth: errors, tables, figures, the HTML report and the replay of control steps."""
