/* Links: connections to peers, and the streams that come from them. */
#ifndef IGTL_GATEWAY_PASSAGE_LINKS_H
#define IGTL_GATEWAY_PASSAGE_LINKS_H

#include <sys/epoll.h>

#include "_streams.h"

enum { NATIVE, PYTHON }; /* who reads a link */

/* A message of which the kernel took nothing, or only the beginning: Python queues it, unless the thread that has its memory
 * sends it in time. */
struct unsent {
    uint8_t *data;
    const struct iovec *parts; /* of the message, in the memory of that thread; NULL: it is in ``data`` */
    struct kept *kept;         /* that memory */
    int parts_count;
    ssize_t size, sent; /* the latter with its frame, if it has one */
    char *channel;
    char keep;
    char is_spare; /* the link has its memory */
    struct unsent *next;
};

/* A large message that was read whole, for Python. */
struct large {
    struct rcl_serialized message; /* only its memory */
    char is_checked;               /* its CRC is right */
    struct large *next;
};

struct Link {
    PyObject_HEAD
    Passage *passage;
    int fd, number;
    Stream *streams[BUCKETS]; /* owns a reference to each */
    int stream_count;
    /* reading; guarded by `reading` */
    pthread_mutex_t reading;
    _Atomic int reader;
    int failure; /* errno of the last reading; 0: none, or the peer has ended */
    uint8_t *chunk;
    ssize_t start, filled; /* of what was received and not passed on */
    uint8_t *body; /* a large message that is being read; NULL: the chunk is filled */
    ssize_t body_size, body_filled;
    ssize_t pending; /* bytes of the unfinished message after the last turn; atomic */
    char checks;       /* its CRC is taken while it is read, and still in the cache */
    uint64_t body_crc; /* of what is read */
    struct {
        uint8_t names[NAMES_BYTES];
        ssize_t most; /* bytes of a message */
    } large_streams[MAX_LARGE_STREAMS]; /* guarded by the sequence lock */
    int large_stream_count;
    struct large *large, **large_end; /* guarded by the passage's events */
    int large_waiting;                /* read, and not handled by Python yet; atomic */
    int is_paused;                    /* too many of them; atomic */
    double room; /* messages that may arrive at once */
    double rate; /* by which it grows, per second, up to that of one second */
    int64_t rated_ns;
    _Atomic char is_limited; /* there is no room: TCP makes the peer wait */
    int64_t pauses_noted_ns;
    long long pauses; /* that Python has not taken over */
    long long received_messages, received_bytes, heard_ns;
    /* sending; guarded by the lock of the sender */
    Lock *sending;
    _Atomic char clear; /* nothing is queued: what is sent goes to the kernel at once */
    char muted;         /* nothing is sent any more */
    char is_framed;     /* each message has a frame of WebSocket; Python reads, and sends all other frames */
    struct unsent *unsent, **unsent_end; /* oldest first; then the link is not clear */
    struct unsent spare; /* where there is no memory for another one: Python learns of the message, without its bytes */
    struct unsent *lent; /* the one that is in the memory of another thread; that one is the oldest */
    long long unsent_bytes, lent_bytes; /* the latter: how many of the former are of the lent one */
    long long sent_messages, sent_bytes;
    /* events; guarded by the passage */
    Link *next_noted, *next_closed, *next_with_large;
    char is_noted, is_closed, is_with_large;
    /* turns, as in turns.py; of the reading thread alone, but Python looks whether the link waits */
    Link *next_waiting;
    int64_t turn_ns;
    _Atomic char waits;
    /* pauses; likewise */
    Link *next_limited;
    int64_t pause_ends_ns;
    char is_listed; /* it is in the list */
};

static unsigned bucket_of(const uint8_t *names)
{
    uint32_t hash = 2166136261u;
    for (int i = 0; i < NAMES_BYTES; i++)
        hash = (hash ^ names[i]) * 16777619u;
    return (hash ^ hash >> 16) % BUCKETS;
}

/* One of the streams of these names; they differ in their metadata. */
static Stream *stream_named(Stream *stream, const uint8_t *names)
{
    while (stream && memcmp(stream->names, names, NAMES_BYTES))
        stream = stream->next;
    return stream;
}

/* The stream of a whole message. */
static Stream *stream_of(Link *self, const uint8_t *message, ssize_t size)
{
    Stream *stream = stream_named(self->streams[bucket_of(message)], message);
    while (stream && !has_metadata(&stream->metadata, message, size))
        stream = stream_named(stream->next, message);
    return stream;
}

static int has_stream(Link *self, const Stream *stream)
{
    const Stream *one = self->streams[bucket_of(stream->names)];
    while (one && one != stream)
        one = one->next;
    return one != NULL;
}

static void wake_links(Passage *passage)
{
    uint64_t one = 1;
    if (write(passage->wake, &one, sizeof one) < 0)
        return; /* it is awake already */
}

/* Have Python look at a link. */
static void note_link(Link *self)
{
    Passage *passage = self->passage;
    pthread_mutex_lock(&passage->events);
    if (!self->is_noted) {
        self->is_noted = 1;
        self->next_noted = passage->noted;
        passage->noted = self;
    }
    pthread_mutex_unlock(&passage->events);
    wake_links(passage);
}

/* Give the link to Python, with what is left in the chunk; the caller has `reading`. */
static void give_to_python(Link *self, int failure)
{
    self->failure = failure;
    self->reader = PYTHON;
    epoll_ctl(self->passage->epoll, EPOLL_CTL_DEL, self->fd, NULL);
    note_link(self);
}

/* The most bytes of a large message with these names; 0: Python reads it. */
static ssize_t most_of_large(const Link *self, const uint8_t *names)
{
    for (int i = 0; i < self->large_stream_count; i++)
        if (!memcmp(self->large_streams[i].names, names, NAMES_BYTES))
            return self->large_streams[i].most;
    return 0;
}

#endif
