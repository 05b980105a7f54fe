"""Tests without hardware, for authors of programs that communicate with the gateway: a pytest plugin and its classes.

pytest loads ``plugin`` automatically if igtl-gateway is installed.  Its fixtures are ``igtl_replay`` (``peer``: a
recording as an OpenIGTLink peer), ``igtl_gateway`` (``gateway``: the core of the gateway on manual time),
``assert_session_equal`` (``compare``) and ``igtl_resim`` (of the add-on resim).  They import their modules when they
are used.  The guide is docs/how-to/testing.md.
"""
