"""What Linux, macOS and Windows do differently: files, signals, processes and clocks.

Modules that only one family of systems has are imported here, and in few places with a purpose of their own
(``tests/test_architecture.py`` has the table).
"""
