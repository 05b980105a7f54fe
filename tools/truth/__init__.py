"""Worlds whose truth is known at every instant, and what each route out of the product makes of them.

A world is a row of conditions and a seed.  It becomes a session by the product's own core, goes through the verbs that
change files, and leaves by the routes.  An official reader of each format reads the result, and the judge compares it
with the truth: in millimetres, at physical time, by name.  A check is right, refused, stated or SILENT.

    python -m tools.truth --worlds 100 --seed 1 [--route csv] [--conditions delay,two_clocks]

The rooms: ``world`` what is true, ``wire`` bytes of its peers, ``senders`` who sends it and when, ``conditions`` what
is special, ``files`` what the verbs do to the file, ``routes`` the ways out, ``judges`` the readers of others and
the comparison, ``mutants`` faults that the judge must find, ``table`` the run and its page.
"""
