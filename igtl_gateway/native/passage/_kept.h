/* The memory of a large message, which several may share. */
#ifndef IGTL_GATEWAY_PASSAGE_KEPT_H
#define IGTL_GATEWAY_PASSAGE_KEPT_H

#include <stdlib.h>
#include <string.h>
#include <sys/types.h>

#include "_rcl.h"
#include "_states.h"

/* A large message whose memory the thread that passes it, the list of those that are to be copied and the stream share; the
 * last one frees it.  STATES.md has its states. */
struct kept {
    int owners; /* atomic */
    enum kept_state state;
    struct rcl_serialized message; /* only its memory */
};

static void move_kept(struct kept *kept, enum kept_state state)
{
    kept->state = (enum kept_state)moved("a message", KEPT_MOVES, kept->state, state);
}

/* The memory of a message as one that can be shared; NULL: there is no memory for that. */
static struct kept *keep(struct rcl_serialized *message)
{
    struct kept *kept = calloc(1, sizeof *kept);
    if (!kept)
        return NULL;
    kept->owners = 1;
    kept->state = OWN;
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
    move_kept(kept, GONE);
    free(kept->message.buffer);
    free(kept);
}

/* The message was refused: its memory goes back to where it came from. */
static void give_back(struct kept *kept)
{
    if (kept)
        move_kept(kept, GONE);
    free(kept);
}

#endif
