"""Training sets for LeRobot (formats v2.1 and v3.0) from a recording and a recipe; see ``docs/how-to/lerobot.md``."""

# pyarrow is an extra; the import of this module has the message that states how to install it
from igtl_gateway.api import arrow_tables as arrow_tables
