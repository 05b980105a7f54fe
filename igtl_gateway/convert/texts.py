"""STRING ⇄ std_msgs/String, STATUS ⇄ diagnostic_msgs/DiagnosticStatus."""

from __future__ import annotations

from igtl_gateway.base.errors import ConversionError
from igtl_gateway.base.quantities import counted
from igtl_gateway.convert.columns import fit_texts
from igtl_gateway.convert.context import ConvertedMessage, ToIgtlContext, ToRosContext
from igtl_gateway.convert.rosmsg import DiagnosticStatus
from igtl_gateway.convert.rosmsg import String as RosString
from igtl_gateway.wire.fields import visible
from igtl_gateway.wire.text import CODES, MAX_STRING_BYTES, Status, String

OK, WARN, ERROR, STALE = range(4)

#: Status codes of a temporary state: busy, not ready, manual mode, disabled, shutting down.
_WARNING_CODES = frozenset({6, 13, 14, 15, 19})
_STATUS_OK = 1
#: Level → code for diagnostics without a code: OK, not ready, unknown error, timeout.
_CODE_OF_LEVEL = {OK: 1, WARN: 13, ERROR: 2, STALE: 7}

#: Keys of the values without a field in DiagnosticStatus.
_CODE, _SUBCODE, _ERROR_NAME = "code", "subcode", "error_name"
_ERROR_NAME_BYTES = 19  # one less than the field: the reference reader drops a name that fills it


def string_to_ros(content: String, _: ToRosContext) -> RosString:
    """Convert to String: the text, decoded from its encoding, in UTF-8."""
    return RosString(content.text)


def string_to_igtl(message: RosString, _: ToIgtlContext) -> ConvertedMessage:
    """Convert to STRING.  Raises ConversionError for more than 65,535 bytes: the length field has 16 bits."""
    content = String.of(message.data)
    if len(content.data) > MAX_STRING_BYTES:
        raise ConversionError(
            f"std_msgs/String: found {counted(len(content.data), 'byte')} of UTF-8, expected at most "
            f"{MAX_STRING_BYTES}: "
            "STRING has a 16-bit length"
        )
    return ConvertedMessage(content)


def status_to_ros(content: Status, to: ToRosContext) -> DiagnosticStatus:
    """Convert to DiagnosticStatus: code 1 is OK, codes of a temporary state are WARN, all others ERROR.

    Code, sub-code and error name become values.
    """
    level = OK if content.code == _STATUS_OK else WARN if content.code in _WARNING_CODES else ERROR
    message = visible(content.message) or (CODES[content.code] if content.code < len(CODES) else "")
    values = (
        (_CODE, str(content.code)),
        (_SUBCODE, str(content.subcode)),
        (_ERROR_NAME, visible(content.error_name)),
    )
    return DiagnosticStatus(level, to.device_name, message, "", values)


def status_to_igtl(message: DiagnosticStatus, to: ToIgtlContext) -> ConvertedMessage:
    """Convert to STATUS; without a value ``code`` the level determines the code."""
    values = dict(message.values)
    try:
        code = int(values.get(_CODE, _CODE_OF_LEVEL.get(message.level, 2)))
        subcode = int(values.get(_SUBCODE, 0))
    except ValueError:
        raise ConversionError(f"DiagnosticStatus: found values {values}, expected integers") from None
    if not 0 <= code < 1 << 16 or not -(1 << 63) <= subcode < 1 << 63:
        raise ConversionError(f"DiagnosticStatus: found code {code}, subcode {subcode}, expected uint16 and int64")
    (error_name,) = fit_texts((values.get(_ERROR_NAME, ""),), _ERROR_NAME_BYTES, "error_name", to)
    return ConvertedMessage(Status(code, subcode, error_name, message.message))
