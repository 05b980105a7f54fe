"""The classes of all types of the gateway."""

from __future__ import annotations

import pytest

from igtl_gateway.base.errors import ConfigError
from igtl_gateway.convert.rosmsg import String
from igtl_gateway.testing.rostypes import unpack


def test_a_type_is_decoded_and_an_unknown_one_is_an_error() -> None:
    assert unpack("std_msgs/msg/String", String("hello").pack()) == String("hello")
    with pytest.raises(ConfigError, match="found a message of type my_msgs/msg/Own"):
        unpack("my_msgs/msg/Own", b"")
