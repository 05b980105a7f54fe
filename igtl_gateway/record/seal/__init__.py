"""Seals: signed statements about the bytes of a recording, in standard envelopes.

``envelope`` is DSSE, ``keys`` are Ed25519, ``statement`` is what is signed, ``time_stamps`` are replies of RFC 3161.
This folder knows bytes only: ``sessionfile`` writes seals into a file and checks them.  docs/how-to/seal.md has the
format.
"""
