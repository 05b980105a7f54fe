"""Other programs' files: into sessions, and out of sessions.  One module per format; see ``docs/formats.md``."""
