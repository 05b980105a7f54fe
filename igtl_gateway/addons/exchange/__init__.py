"""Import from and export to the file formats of other programs, one module each; see ``docs/reference/formats.md``."""
