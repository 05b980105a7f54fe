/* Compiled streams, their outputs and their latest message. */
#ifndef IGTL_GATEWAY_PASSAGE_STREAMS_H
#define IGTL_GATEWAY_PASSAGE_STREAMS_H

#include "../kernel/_bulk_to_igtl.h"
#include "../kernel/_bulk_to_ros.h"
#include "_guard.h"
#include "_kept.h"
#include "_publishing.h"

/* One output of a stream. */
struct output {
    uint8_t *template;           /* of bulk to OpenIGTLink: the bytes before the content */
    ssize_t size, at, digits_at; /* at: of the stamp (to ROS), of the numbers (to OpenIGTLink) */
    ssize_t id_at;               /* of metadata beside a pose to ROS: of the message id; 0: it is the pose */
    uint8_t *tail;               /* of bulk to OpenIGTLink: the bytes after the content */
    ssize_t tail_size;
    struct ros_form form;        /* of bulk to ROS */
    char keep;                   /* a full send queue must not drop it */
    uint64_t number;             /* of its stream in the recorder's queue */
    uint64_t sent;               /* messages */
    long long ignored;           /* messages that a link took no more; atomic */
    Publisher *publisher;
    Link *links[MAX_LINKS];
    int link_count;
    char *channel;
};

struct Stream {
    PyObject_HEAD
    Passage *passage;
    Stream *next;                /* of the same bucket */
    Link *link;                  /* to ROS: where it comes from */
    Subscription *subscription;  /* to OpenIGTLink: where it comes from */
    uint8_t names[NAMES_BYTES];
    uint8_t *sample;
    struct metadata metadata; /* to ROS */
    ssize_t at, place_at;
    struct igtl_poses from_igtl;
    struct ros_poses from_ros;
    int is_bulk; /* strings, points, clouds, pictures and tracking data: these instead of the two above */
    struct igtl_bulk bulk_from_igtl;
    struct ros_bulk bulk_from_ros;
    ssize_t places[MAX_PLACES];
    int own;
    struct output outputs[MAX_OUTPUTS];
    int output_count;
    uint64_t number;
    char is_stale; /* the recorder counts streams from the start again */
    Guard *guard; /* NULL: the stream is not guarded; several streams may share one */
    /* since the last collection */
    uint64_t received, converted, unheard;
    uint64_t latest_seq;
    int64_t latest_stamp_ns, latest_source_ns;
    uint8_t *latest;
    ssize_t latest_size;
    char keeps;         /* to ROS: the latest message is kept, too */
    unsigned waits;     /* of the latest message, see choose_outputs */
    struct kept *large; /* the latest message, if it is large */
    int is_in_use;      /* a thread passes a message on without the sequence lock and the GIL; atomic */
};

/* Note the latest message of a stream; returns the memory of the one before, if it was large, for the caller to leave: to free it
 * takes longer than a lock may be held. */
static struct kept *set_latest(Stream *stream, uint64_t seq, int64_t stamp_ns, int64_t source_ns, struct kept *large)
{
    stream->latest_seq = seq;
    stream->latest_stamp_ns = stamp_ns;
    stream->latest_source_ns = source_ns;
    struct kept *before = stream->large;
    if ((stream->large = large))
        __atomic_add_fetch(&large->owners, 1, __ATOMIC_RELAXED);
    return before;
}

static uint8_t *scratch_of(Passage *self, int output) { return self->scratch + (size_t)output * LARGEST_OUTPUT; }

static uint8_t *copied(const void *data, ssize_t size)
{
    uint8_t *copy = malloc(size ? (size_t)size : 1);
    if (copy)
        memcpy(copy, data, (size_t)size);
    return copy;
}

#endif
