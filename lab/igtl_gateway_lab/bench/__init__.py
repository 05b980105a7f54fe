"""Measurements: how long a message takes through the gateway, how many get through, and what that costs.

The gateway is a process of its own, started as users start it.  The programs on both sides of it cost as little as
they can: they send bytes that were made beforehand and look at one number in what arrives.  The same programs, without
the gateway between them, give the floor: what the middleware and the sockets cost alone.
"""
