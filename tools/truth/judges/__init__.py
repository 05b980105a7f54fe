"""The judges: official readers of each format, and the comparison of what they read with the truth."""
