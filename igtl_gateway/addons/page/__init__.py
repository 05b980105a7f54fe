"""A page for the browser: links and streams of a running bridge, its recording, closed recordings, and replays.

The page is served by a process of its own (``process``), which reads the bridge through one local interface
(``live``): what browsers do, or a crash of that process, does not reach the bridge.
"""
