"""Import from and export to the file formats of other programs, one module per format; see ``docs/formats.md``."""
