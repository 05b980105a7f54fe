"""The session log as a concept: entries, notes, and how they are laid out in a file.  No file is touched here."""
