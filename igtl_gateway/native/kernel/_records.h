/* The records in an unpacked chunk of MCAP, and the head of igtl_msgs/RawMessage in a message.
 *
 * The bytes are of any origin: nothing is read beyond them, whatever lengths they state.  Offsets are into the chunk.
 * Numbers in MCAP and CDR are little-endian here.
 */
#ifndef IGTL_GATEWAY_RECORDS_H
#define IGTL_GATEWAY_RECORDS_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* MCAP: opcode and length of each record; then, of a message, channel, sequence, log_time and publish_time. */
#define RECORD_HEAD 9
#define MESSAGE 5
#define MESSAGE_HEAD 22
#define SEQUENCE_AT 2 /* behind RECORD_HEAD */
#define TIME_AT 6
#define PUBLISH_AT 14

/* igtl_msgs/RawMessage: encapsulation, stamp, source_stamp, source_ticks, direction; igtl_gateway/record/sessionfile/messages.py */
#define RAW_HEAD 32
#define RAW_SOURCE_AT 12
#define RAW_DIRECTION_AT 28

static inline uint64_t record_u64(const uint8_t *at)
{
    uint64_t value;
    memcpy(&value, at, 8);
    return value;
}

static inline uint32_t record_u32(const uint8_t *at)
{
    uint32_t value;
    memcpy(&value, at, 4);
    return value;
}

/* -- messages ----------------------------------------------------------------------------------------------------- */

/* The end of the record at ``at``, which is below ``size``; 0: it does not fit. */
static inline size_t record_end(const uint8_t *data, size_t size, size_t at)
{
    if (size - at < RECORD_HEAD)
        return 0;
    const uint64_t length = record_u64(data + at + 1);
    if (length > size - at - RECORD_HEAD || (data[at] == MESSAGE && length < MESSAGE_HEAD))
        return 0;
    return at + RECORD_HEAD + (size_t)length;
}

struct messages_found {
    size_t count;
    size_t end;    /* of the last record that fits: less than the size where one does not */
    uint64_t late; /* the highest bit is that of any time */
    int in_order;  /* no time is less than that before it */
};

static inline struct messages_found count_messages(const uint8_t *data, size_t size)
{
    struct messages_found found = {0, 0, 0, 1};
    uint64_t last = 0;
    while (found.end < size) {
        const size_t at = found.end, end = record_end(data, size, at);
        if (!end)
            break;
        if (data[at] == MESSAGE) {
            const uint64_t time = record_u64(data + at + RECORD_HEAD + TIME_AT);
            found.late |= time | record_u64(data + at + RECORD_HEAD + PUBLISH_AT);
            found.in_order &= time >= last;
            found.count++;
            last = time;
        }
        found.end = end;
    }
    return found;
}

/* A column for each field; begins and ends are of the payload. */
struct message_columns {
    uint16_t *channels;
    uint32_t *sequences;
    uint64_t *times, *publish_times;
    int64_t *begins, *ends;
};

/* Fill rows with the messages from ``*at`` on, at most ``most``; return how many.  ``*at`` is then behind the last one. */
static inline size_t take_messages(const uint8_t *data, size_t size, size_t *at, size_t most,
                                   const struct message_columns *rows)
{
    size_t taken = 0;
    while (taken < most && *at < size) {
        const size_t begin = *at, end = record_end(data, size, begin);
        if (!end)
            break;
        if (data[begin] == MESSAGE) {
            const uint8_t *head = data + begin + RECORD_HEAD;
            memcpy(&rows->channels[taken], head, 2);
            rows->sequences[taken] = record_u32(head + SEQUENCE_AT);
            rows->times[taken] = record_u64(head + TIME_AT);
            rows->publish_times[taken] = record_u64(head + PUBLISH_AT);
            rows->begins[taken] = (int64_t)(begin + RECORD_HEAD + MESSAGE_HEAD);
            rows->ends[taken] = (int64_t)end;
            taken++;
        }
        *at = end;
    }
    return taken;
}

/* -- RawMessages -------------------------------------------------------------------------------------------------- */

/* Heads that are known: the bytes from the links to the device name, with the padding behind it.  Those of one channel
 * are a ring, so that the next message begins with the head of the last one. */
struct raw_heads {
    const uint8_t *bytes;
    const int64_t *offsets; /* count + 1, of each in ``bytes`` */
    const int32_t *next;    /* the head that follows in the ring */
    int32_t *last;          /* by channel: the head of its last message; -1: none */
    int32_t count;
};

/* How many heads of a channel are compared with a message. */
#define RAW_MOST_HEADS 64

#define RAW_OUTGOING 1 /* the direction that the message states */
#define RAW_STAMPED 2  /* it has a source stamp */

/* The place of the payload in a RawMessage with this head; 0: it has another one, or other bytes than its fields. */
static inline size_t raw_payload(const uint8_t *raw, size_t size, const uint8_t *head, size_t head_size)
{
    const size_t place = RAW_HEAD + head_size + 4;
    if (size < place || raw[0] != 0 || raw[1] != 1 || memcmp(raw + RAW_HEAD, head, head_size) != 0)
        return 0;
    return record_u32(raw + place - 4) == size - place ? place : 0;
}

/* The place of the payload in a RawMessage, and its head; 0: no head that is known. */
static inline size_t raw_place(const uint8_t *raw, size_t size, uint16_t channel, const struct raw_heads *heads,
                               int32_t *head)
{
    const int32_t first = heads->last[channel];
    int32_t at = first;
    for (int i = 0; i < RAW_MOST_HEADS && at >= 0 && at < heads->count; i++) {
        const int64_t begin = heads->offsets[at];
        const size_t place = raw_payload(raw, size, heads->bytes + begin, (size_t)(heads->offsets[at + 1] - begin));
        if (place) {
            heads->last[channel] = *head = at;
            return place;
        }
        at = heads->next[at];
        if (at == first)
            break;
    }
    return 0;
}

static inline uint8_t raw_flags(const uint8_t *raw)
{
    return (uint8_t)((raw[RAW_DIRECTION_AT] ? RAW_OUTGOING : 0) | (record_u64(raw + RAW_SOURCE_AT) ? RAW_STAMPED : 0));
}

#endif
