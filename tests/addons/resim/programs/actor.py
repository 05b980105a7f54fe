"""Becomes the program of an actor of a scenario, as ``igtl-gateway simulate`` starts it: with "begin" on its input.

The arguments are the scenario and the actor.
"""

import os
import sys

reading, writing = os.pipe()  # stays open: the end of the input would end the program
os.write(writing, b"begin\n")
os.dup2(reading, 0)
os.set_inheritable(writing, True)
scenario, actor = sys.argv[1:]
os.execv(sys.executable, [sys.executable, "-m", "igtl_gateway", "simulate", scenario, "--actor", actor])
