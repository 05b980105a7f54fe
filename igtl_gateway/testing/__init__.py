"""Tests without hardware, for authors of programs that talk to the gateway: a pytest plugin and what is behind it.

The fixtures are in ``plugin`` and found by pytest by themselves where igtl-gateway is installed: ``igtl_replay``
(``peer``: a recording as an OpenIGTLink peer), ``igtl_gateway`` (``gateway``: the real core on manual time) and
``assert_session_equal`` (``compare``).  docs/testing.md is the guide.  Nothing here is imported before it is used.
"""
