/* The memory of a large message, which several may share. */
#ifndef IGTL_GATEWAY_PASSAGE_KEPT_H
#define IGTL_GATEWAY_PASSAGE_KEPT_H

#include <stdlib.h>
#include <string.h>
#include <sys/types.h>

#include "_rcl.h"

/* A large message whose memory the thread that passes it and the stream share; the last one frees it. */
struct kept {
    int owners; /* atomic */
    struct rcl_serialized message; /* only its memory */
};

/* The memory of a message as one that can be shared; NULL: there is no memory for that. */
static struct kept *keep(struct rcl_serialized *message)
{
    struct kept *kept = calloc(1, sizeof *kept);
    if (!kept)
        return NULL;
    kept->owners = 1;
    kept->message = *message;
    return kept;
}

static struct kept *keep_copy(const uint8_t *data, ssize_t size)
{
    struct rcl_serialized message = {.buffer = malloc((size_t)size), .length = (size_t)size};
    struct kept *kept = message.buffer ? keep(&message) : NULL;
    if (kept)
        memcpy(message.buffer, data, (size_t)size);
    else
        free(message.buffer);
    return kept;
}

static void leave_kept(struct kept *kept)
{
    if (!kept || __atomic_sub_fetch(&kept->owners, 1, __ATOMIC_ACQ_REL))
        return;
    free(kept->message.buffer);
    free(kept);
}

#endif
