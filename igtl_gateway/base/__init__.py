"""What everything stands on: time, numbers, text, errors, the system, and guards against data of others."""
