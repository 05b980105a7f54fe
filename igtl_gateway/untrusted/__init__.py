"""Guards for everything that another program or another person wrote: how files are opened, what reading them may
cost, and how their text reaches a terminal.

Every reader of files opens them by :mod:`igtl_gateway.untrusted.files`, asks :mod:`igtl_gateway.untrusted.limits`
before it allocates, unpacks, nests or repeats, and every text that is printed passes
:func:`igtl_gateway.untrusted.text.printable`.  ``docs/hostile-files.md`` has the table of what was tried.
"""
