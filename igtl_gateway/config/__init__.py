"""How a user configures a session: the table of settings, the configuration file, and how values are written."""
