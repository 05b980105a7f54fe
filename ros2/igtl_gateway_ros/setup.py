from setuptools import setup  # colcon runs this file; setup.cfg has everything

setup()
