"""Training sets for LeRobot (formats v2.1 and v3.0) from a recording and a recipe; see ``docs/how-to/lerobot.md``."""
