"""One session of several recorders: the offsets of their clocks, and the file with the parts."""
