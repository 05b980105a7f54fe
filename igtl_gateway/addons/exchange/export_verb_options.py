"""The options of ``igtl-gateway export``."""

from __future__ import annotations

from igtl_gateway.addon.processes import is_present, part_of

#: The format of another add-on, which has its options.
LEROBOT = "lerobot"
LEROBOT_ROW = [(LEROBOT, part_of(LEROBOT, "options:LEROBOT_TEXT"))] if is_present(LEROBOT) else []
