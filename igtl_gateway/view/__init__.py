"""The session as a picture: entries in, a rerun recording out.  The only package that imports rerun."""
