"""Views of a session in rerun: entries in, a rerun recording out.  Only this package imports rerun."""
