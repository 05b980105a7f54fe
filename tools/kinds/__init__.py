"""Files with one wrong value, whose kinds follow from a grammar of each format: ``python -m tools.fuzz_values``.

A builder writes a format field by field and names each of its values to a :class:`~tools.kinds.values.Maker`.  So the
kinds of a format are all its fields with all choices of their types; no list of damages is written by hand.
"""
