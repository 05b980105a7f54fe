/* The memory that the bridge shares with the recorder: its layout, and the native writer.
 *
 * igtl_gateway/record/shared_queue.py has the writer and the reader in Python; tests/record/test_shared_queue.py compares
 * its constants with these.  The writers in Python and in C alternate under one lock.  The reader takes no
 * lock: the position is the only number that it waits for.
 *
 * The memory begins with a page of counters (64-bit words in the order of the machine); the room for records follows.
 * Places are offsets into the room.  Positions count the bytes of records and marks since the start, and only grow.
 *
 * A record is QUEUE_RECORD_BYTES of head (five words) and its bytes, padded to QUEUE_ALIGN; it is never split:
 *
 *     what                  bytes after the head     size            3rd word                4th        5th
 *     number of a stream    payload                  of the payload  entry number            stamp      source stamp
 *     QUEUE_MARK            none                     place of the next record                0          0          0
 *     QUEUE_COMMAND         marshalled words         0               length of the words     0          0
 *     QUEUE_STREAM          marshalled words         0               length of the words     0          0
 *     QUEUE_ENTRY           marshalled words,        of the payload  length of the words     0          0
 *                           payload
 *
 * The words of QUEUE_STREAM are kind, channel, type and links of the stream that gets the next number.  The words of
 * QUEUE_ENTRY are all fields of an entry that has no number of a stream.  Stamps are UTC nanoseconds.
 *
 * QUEUE_FILLING is added to ``what`` while the payload is copied without the lock.  The reader waits at such a record.
 * QUEUE_VOID is added instead if the payload is lost.  Behind each record there is room for a mark.
 */
#ifndef IGTL_GATEWAY_QUEUE_H
#define IGTL_GATEWAY_QUEUE_H

#include <stdint.h>
#include <string.h>

#define QUEUE_PAGE 4096
#define QUEUE_RECORD_BYTES 40
#define QUEUE_ALIGN 16
#define QUEUE_MAX_STREAMS 10000
#define QUEUE_MARK 10000
#define QUEUE_COMMAND 10001
#define QUEUE_STREAM 10002
#define QUEUE_ENTRY 10003
#define QUEUE_FILLING (1ULL << 32)
#define QUEUE_VOID (1ULL << 33)

/* Slots of the page.  Written by the writers, read by the reader: */
#define QUEUE_HEAD 0    /* position of the next record: up to here the reader may read */
#define QUEUE_REFUSED 1 /* entries for which there was no room */
#define QUEUE_RESTART 2 /* position of the record that is at place 0 without a mark before it: the queue was empty */
/* Written by the reader: */
#define QUEUE_TAIL 8          /* position up to which the room is free again */
#define QUEUE_DONE_ENTRIES 9  /* entries that it is done with */
#define QUEUE_DONE_BYTES 10   /* what they counted */
#define QUEUE_AWAITS 11       /* 1: it waits for a payload that is being copied; of Python only */
#define QUEUE_FLUSHED 12      /* entries that are in the file for good; of Python only */
/* Written by both: */
#define QUEUE_BELL 16 /* 1: the reader's attention was asked for, and it did not look since */
/* Of the writers only, under their lock: */
#define QUEUE_PLACE 32   /* place of the next record */
#define QUEUE_LIMIT 33   /* place up to which nothing is in the way */
#define QUEUE_ENTRIES 34 /* entries put so far */
#define QUEUE_TAKEN 35   /* what they count: payload and QUEUE_ENTRY_BYTES each */
/* Of the writers only, seldom changed: */
#define QUEUE_MAX_ENTRIES 40
#define QUEUE_MAX_BYTES 41
#define QUEUE_GENERATION 42 /* how often the numbers of streams started again */
#define QUEUE_CLOSED 43     /* 1: the native writer puts nothing any more */

#define QUEUE_ENTRY_BYTES 500      /* what an entry counts beside its payload */
#define QUEUE_WAKE_BYTES (8 << 20) /* the reader's attention is asked for when so much waits */
#define QUEUE_WAKE_ENTRIES 2000
#define QUEUE_LARGE_BYTES (64 << 10) /* payloads from here on give way first; Python copies them without the lock */

struct queue {
    uint64_t *counters; /* the page */
    uint8_t *room;      /* the rest */
};

/* ``memory``: that of QueueWriter.memory; it has to stay mapped. */
static inline struct queue queue_open(void *memory)
{
    struct queue queue = {(uint64_t *)memory, (uint8_t *)memory + QUEUE_PAGE};
    return queue;
}

static inline uint64_t queue_need(uint64_t size)
{
    return (QUEUE_RECORD_BYTES + size + QUEUE_ALIGN - 1) & ~(uint64_t)(QUEUE_ALIGN - 1);
}

/* Whether a stream, as QueueWriter.stream_number returned it, still has its number. */
static inline int queue_knows(const struct queue *queue, uint64_t stream)
{
    return stream >> 32 == queue->counters[QUEUE_GENERATION];
}

/* Entries and bytes that wait, with these. */
static inline void queue_waiting(const struct queue *queue, uint64_t *entries, uint64_t *bytes)
{
    const uint64_t *counters = queue->counters;
    *bytes += *entries * QUEUE_ENTRY_BYTES;
    *entries += counters[QUEUE_ENTRIES] - __atomic_load_n(&counters[QUEUE_DONE_ENTRIES], __ATOMIC_ACQUIRE);
    *bytes += counters[QUEUE_TAKEN] - __atomic_load_n(&counters[QUEUE_DONE_BYTES], __ATOMIC_ACQUIRE);
}

/* Whether the reader's attention is to be asked for with these entries, and was not. */
static inline int queue_presses(const struct queue *queue, uint64_t entries, uint64_t payload_bytes)
{
    queue_waiting(queue, &entries, &payload_bytes);
    return (payload_bytes > QUEUE_WAKE_BYTES || entries > QUEUE_WAKE_ENTRIES) &&
           !__atomic_load_n(&queue->counters[QUEUE_BELL], __ATOMIC_RELAXED);
}

/* Bytes that the next records may have together. */
static inline uint64_t queue_left(const struct queue *queue)
{
    const uint64_t *counters = queue->counters;
    return counters[QUEUE_LIMIT] > counters[QUEUE_PLACE] ? counters[QUEUE_LIMIT] - counters[QUEUE_PLACE] : 0;
}

/* Whether there is room for all of these entries at once; the caller has the lock. */
static inline int queue_has_room(const struct queue *queue, uint64_t entries, uint64_t payload_bytes)
{
    const uint64_t *counters = queue->counters;
    uint64_t before = entries, bytes = payload_bytes, most = counters[QUEUE_MAX_BYTES];
    queue_waiting(queue, &before, &bytes);
    if (payload_bytes >= QUEUE_LARGE_BYTES) /* one of them might be large: these give way first */
        most -= most / 8;
    return !counters[QUEUE_CLOSED] && before <= counters[QUEUE_MAX_ENTRIES] && bytes <= most &&
           payload_bytes + entries * (QUEUE_RECORD_BYTES + QUEUE_ALIGN) <= queue_left(queue);
}

/* Whether these entries can be put without Python, which otherwise finds more room, wakes the reader, or counts them as
 * dropped; the caller has the lock. */
static inline int queue_fits(const struct queue *queue, uint64_t entries, uint64_t payload_bytes)
{
    return queue_has_room(queue, entries, payload_bytes) && !queue_presses(queue, entries, payload_bytes);
}

/* Begin an entry, for which queue_fits and queue_knows were true; the caller has the lock since then.
 *
 * Returns where the payload belongs, for the caller to copy it; queue_publish has to follow.
 */
static inline uint8_t *queue_begin(struct queue *queue, uint64_t stream, uint64_t number, uint64_t stamp_ns,
                                   uint64_t source_ns, uint64_t size)
{
    uint8_t *at = queue->room + queue->counters[QUEUE_PLACE];
    const uint64_t head[5] = {stream & 0xFFFFFFFF, size, number, stamp_ns, source_ns};
    memcpy(at, head, QUEUE_RECORD_BYTES);
    return at + QUEUE_RECORD_BYTES;
}

/* Hand the entry that was begun to the reader. */
static inline void queue_publish(struct queue *queue, uint64_t size)
{
    uint64_t *counters = queue->counters;
    counters[QUEUE_PLACE] += queue_need(size);
    counters[QUEUE_ENTRIES] += 1;
    counters[QUEUE_TAKEN] += size + QUEUE_ENTRY_BYTES;
    __atomic_store_n(&counters[QUEUE_HEAD], counters[QUEUE_HEAD] + queue_need(size), __ATOMIC_RELEASE);
}

/* Put an entry, under the conditions of queue_begin, whose payload is to be copied to the place that is returned, also
 * without the lock; queue_filled has to follow. */
static inline uint8_t *queue_reserve(struct queue *queue, uint64_t stream, uint64_t number, uint64_t stamp_ns,
                                     uint64_t source_ns, uint64_t size)
{
    uint8_t *at = queue_begin(queue, stream, number, stamp_ns, source_ns, size);
    const uint64_t what = (stream & 0xFFFFFFFF) | QUEUE_FILLING;
    memcpy(at - QUEUE_RECORD_BYTES, &what, sizeof what);
    queue_publish(queue, size);
    return at;
}

/* Hand an entry to the reader whose payload is in its place now. */
static inline void queue_filled(uint8_t *at)
{
    uint64_t *what = (uint64_t *)(void *)(at - QUEUE_RECORD_BYTES);
    __atomic_store_n(what, *what & ~QUEUE_FILLING, __ATOMIC_RELEASE);
}

/* Put an entry, under the conditions of queue_begin. */
static inline void queue_add(struct queue *queue, uint64_t stream, uint64_t number, uint64_t stamp_ns,
                             uint64_t source_ns, const void *payload, uint64_t size)
{
    memcpy(queue_begin(queue, stream, number, stamp_ns, source_ns, size), payload, size);
    queue_publish(queue, size);
}

/* Put one entry; 0 if Python has to do it.  The caller has the lock. */
static inline int queue_put(struct queue *queue, uint64_t stream, uint64_t number, uint64_t stamp_ns,
                            uint64_t source_ns, const void *payload, uint64_t size)
{
    if (size >= QUEUE_LARGE_BYTES || !queue_knows(queue, stream) || !queue_fits(queue, 1, size))
        return 0;
    queue_add(queue, stream, number, stamp_ns, source_ns, payload, size);
    return 1;
}

#endif
