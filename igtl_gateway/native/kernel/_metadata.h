/* The metadata of compiled streams of header version 2, which igtl_gateway/gateway/fastpath/metadata.py documents: a
 * constant block at the end of each message; without Python.
 *
 * Nothing of them is read: sizes and bytes are compared with those of the message that the stream was compiled from.
 */
#ifndef IGTL_GATEWAY_METADATA_H
#define IGTL_GATEWAY_METADATA_H

#include "_bytes.h"

#define MESSAGE_ID_BYTES 4 /* the end of the extended header */
#define MESSAGE_ID_AT (HEADER_SIZE + EXTENDED_SIZE - MESSAGE_ID_BYTES)

/* The metadata of a stream with the sizes in the extended header, as they are in its sample; size 0: header version 1. */
struct metadata {
    const uint8_t *sizes, *block;
    ssize_t size;
};

/* Return whether a whole message has these metadata. */
static inline int has_metadata(const struct metadata *known, const uint8_t *message, ssize_t size)
{
    if (!known->size)
        return 1;
    return size >= HEADER_SIZE + EXTENDED_SIZE + known->size &&
           !memcmp(message + HEADER_SIZE, known->sizes, EXTENDED_SIZE - MESSAGE_ID_BYTES) &&
           !memcmp(message + size - known->size, known->block, (size_t)known->size);
}

/* Write the id of a message into the ROS message of its metadata, in the byte order of CDR. */
static inline void put_message_id(uint8_t *cdr, ssize_t id_at, const uint8_t *message)
{
    uint32_t id = get_u32(message + MESSAGE_ID_AT);
    memcpy(cdr + id_at, &id, MESSAGE_ID_BYTES);
}

#endif
