"""Lags between streams: their movement (``signal``), the estimate (``lag``, ``fit``), and PLUS's method (``plus``)."""
