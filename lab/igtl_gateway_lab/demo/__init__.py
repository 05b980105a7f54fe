"""The two independent programs that the demo bridges.  They use nothing of igtl_gateway but this folder.

Each runs in its own process and prints one JSON object per line: ``ready``, then ``summary`` at the end.
"""
