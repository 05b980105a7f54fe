"""Becomes the program of an actor of a scenario, as ``igtl-gateway simulate`` starts it: with "begin" on its input.

The arguments are the scenario and the actor.
"""

import os
import runpy
import sys

reading, writing = os.pipe()  # stays open: the end of the input would end the program
os.write(writing, b"begin\n")
os.dup2(reading, 0)
scenario, actor = sys.argv[1:]
sys.argv = ["igtl-gateway", "simulate", scenario, "--actor", actor]
runpy.run_module("igtl_gateway", run_name="__main__")
