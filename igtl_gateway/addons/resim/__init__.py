"""Open-loop re-simulation: a recording drives unmodified ROS 2 programs in session time, one event after the other.

``engine.run`` runs the programs, ``verdict.compare`` judges what they published; ``verb`` is ``igtl-gateway resim``.
``coordinator`` decides which event is next; the library ``preload/_preload.c``, preloaded into each program, makes it
happen when all threads of the program wait.
"""
