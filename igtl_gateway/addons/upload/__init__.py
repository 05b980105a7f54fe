"""The copies of closed recordings in an object store: beside a bridge, and as a verb."""
