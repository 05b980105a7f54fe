"""Replay of recordings: playback, comparison, slices and verification.

Called, the package is the function `igtl_gateway.api.verbs.replay`.
"""

import sys

from igtl_gateway import CallablePackage

sys.modules[__name__].__class__ = CallablePackage
