"""The Python API: what a program or a notebook does with recordings and peers; ``igtl_gateway`` has the public names.

Results are frozen dataclasses and numpy arrays.  Units have names (``unit="mm"``), times are integers in UTC
nanoseconds.  Nothing here prints, and errors are those of ``igtl_gateway.base.errors``.
"""
