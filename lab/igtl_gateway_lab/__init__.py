"""The laboratory of igtl-gateway: simulated scenarios, measurements and the demo, as verbs of its command line."""

__version__ = "0.2.0"
