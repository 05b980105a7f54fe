"""MCAP files of another program."""

from __future__ import annotations

from io import BytesIO

from mcap.writer import IndexType, Writer


def plain_mcap(*, summary: bool) -> bytes:
    """Return a file of the library of MCAP, with three messages, and with or without a summary."""
    stream = BytesIO()
    writer = Writer(
        stream,
        index_types=IndexType.ALL if summary else IndexType.NONE,
        repeat_channels=summary,
        repeat_schemas=summary,
        use_statistics=summary,
        use_summary_offsets=summary,
        enable_data_crcs=True,
    )
    writer.start()
    channel = writer.register_channel("/a", "json", writer.register_schema("a", "jsonschema", b"{}"))
    for number in range(3):
        writer.add_message(channel, number, b"{}", number)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()
